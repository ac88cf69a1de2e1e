"""Drivers for real arrays, and emulated devices.

links  --bytes, frames-->  codecs/  --samples-->  accounting, clocks  --chunks-->  device_source
emulation/: the samples of any source, encoded by any codec, sent over a real line, with faults

codec: the interface of all codecs; opening: from a URL to a source; discovery: connected ports and
buses, and their problems; health: the state of a device; slcan: CAN over serial lines.
"""
