"""A stream at rest: an MCAP file (https://mcap.dev) that any MCAP reader opens, Foxglove for one.

    source --chunks, raw packets--> StreamWriter --> FILE.mcap --> Recording, replay:FILE.mcap

    metadata  ``tactile_rt``: the array, what the device speaks, the clock's UTC offset
              ``session``: what the user notes
    samples   chunks, bit for bit
    wire      raw packets as they came, to be decoded again
    health    how source and recorder are doing, at every change
    decisions, events    what the daemon decided and told meanwhile

The layout is described in docs/reference/recording.md.
"""

from tactile_rt.recording.description import Description
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.recovery import recover
from tactile_rt.recording.stream_writer import StreamWriter

__all__ = ["Description", "Recording", "StreamWriter", "recover"]
