"""Drivers for real arrays, and devices that only pretend.

links  --bytes, frames-->  codecs/  --samples-->  accounting, clocks  --chunks-->  device_source
emulation/: any source's samples spoken by any codec over a real line, faults included

codec: what a codec is, and which there are; opening: from a URL to a source; discovery: what is
plugged in, and what may be in the way; health: how a device is doing; slcan: CAN over serial lines.
"""
