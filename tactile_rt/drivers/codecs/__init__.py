"""One device, one module, named like its codec; a frame, a checksum or a command is wrong there.

Two protocols need more room: the native one is spoken over serial lines (`native`) and CAN
(`native_can`), and both share `native_common`; and what a user writes of an unknown device is read
by `ascii_mapping` and `dbc_file`. `framing` holds what many share: the checksums themselves, and
how frames are found.
"""
