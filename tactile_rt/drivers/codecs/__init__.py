"""The codecs, one module for each device, which defines its frames, checksum and commands.

The native protocol has a module for serial lines (`native`), one for CAN (`native_can`) and their
common part, `native_common`. `ascii_mapping` and `dbc_file` read the users' descriptions of other
devices. `framing` is shared by many codecs: checksums, and the search for frames.
"""
