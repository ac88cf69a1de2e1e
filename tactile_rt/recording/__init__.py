"""Recordings: streams stored as MCAP files (https://mcap.dev), which any MCAP reader opens.

    source --chunks, raw packets--> StreamWriter --> FILE.mcap --> Recording, replay:FILE.mcap

    metadata  ``tactile_rt``: the array, the device's codec, the clock's UTC offset
              ``session``: the user's notes
    samples   chunks, bit for bit
    wire      raw packets as they arrived, which can be decoded again
    health    state of source and recorder, at every change
    decisions, events    the daemon's decisions and events during the recording

The layout is described in docs/reference/recording.md.
"""

from tactile_rt.recording.description import Description
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.recovery import recover
from tactile_rt.recording.stream_writer import StreamWriter

__all__ = ["Description", "Recording", "StreamWriter", "recover"]
