"""Drivers for real arrays, and devices that only pretend.

links  --bytes, frames-->  codecs/  --samples-->  device_source    (serial: and can: sources)
emulation/: any source's samples spoken by any codec over a real line, faults included
"""
