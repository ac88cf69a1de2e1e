"""The daemon's recorder driven by hand, and what it is given."""

import time

from tactile_rt.daemon.config import RecorderConfig
from tactile_rt.daemon.items import Opened, SourceChunk
from tactile_rt.daemon.recorder import Recorder
from tactile_rt.daemon.states import Snapshot
from tactile_rt.testing import ArraySource, small_spec

SPEC = small_spec()
UTC = 1_700_000_000_000_000_000


class View:
    """What a consumer sees of its daemon."""

    def __init__(self):
        self.told, self.open = [], {}

    def snapshot(self):
        return Snapshot("0", 1, "robot.toml", 1, UTC, 0, 0, "running")

    def streams(self):
        return self.open

    def config_text(self):
        return "version = 1\n"

    def report(self, part, state, reason, level="info"):
        self.told.append((state, reason, level))

    def send(self, consumer, control):
        return False

    def utc_offset_ns(self):
        return UTC


def opened(name="whiskers", stream=None):
    stream = stream or ArraySource(SPEC, [])
    return Opened(name, stream.spec, f"synthetic:{name}", stream, time.monotonic_ns(), UTC)


def samples(chunk, name="whiskers", at=None):
    return SourceChunk(name, SPEC, chunk, at or time.monotonic_ns(), UTC)


def begun(daemon, folder, **config):
    made = Recorder("recorder", RecorderConfig(folder=str(folder), **config))
    made.open(daemon)
    return made


def look(made):
    """The next look at disk and clock comes now."""
    made._flush_at = 0.0
    made.handle([])


def files(folder):
    return sorted(folder.glob("*.mcap"))
