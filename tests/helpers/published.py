"""Items, and a daemon as its consumers see it, for the tests of publishers."""

import contextlib

import numpy as np

from tactile_rt.classifier.classifier import Classification
from tactile_rt.core.stream import ArraySpec, Chunk, SourceStats
from tactile_rt.daemon import states
from tactile_rt.daemon.items import Closed, Contact, Decision, Event, Opened, SourceChunk
from tactile_rt.drivers.health import Health, State
from tactile_rt.testing import small_spec

UTC = 1_700_000_000_000_000_000
FORCES = ArraySpec(
    name="pair", elements=("B1", "C2"), grid=((0, 0), (1, 1)),
    positions=((0.0, 0.0, 0.0), (0.0, 0.03, 0.0)),
    # The second stands turned by a quarter about z: its own x is the mount's y.
    orientations=((1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.0, 0.5**0.5)),
    channels=("fx", "fy", "fz"), units=("N", "N", "N"), rate_hz=1000.0, frame="head",
)  # fmt: skip


class View:
    """A daemon that is what the test says."""

    def __init__(self, spec=None, snapshot=None):
        self.shown = snapshot or states.Snapshot("0", 1, "robot.toml", 5, UTC + 5, 1, 0, "running")
        self.open = {"whiskers": opened(spec)} if spec else {}
        self.reports = []

    def snapshot(self):
        return self.shown

    def streams(self):
        return self.open

    def report(self, part, state, reason, level="info"):
        self.reports.append((part, state, level))

    def utc_offset_ns(self):
        return UTC


def opened(spec=None, t_ns=1):
    return Opened("whiskers", spec or small_spec(), "synthetic:", None, t_ns, UTC)


def closed(t_ns=9):
    return Closed("whiskers", t_ns)


def event(part="daemon", state="running", reason="", level="info", t_ns=7):
    return Event(part, state, reason, level, t_ns, UTC)


def contact(touching=True):
    return Contact("whiskers", "whiskers", "mount", touching, 8, UTC)


def decision(model="whiskers", p=(0.25, 0.75), t_ns=1000):
    made = Classification(
        10, t_ns, 2, False, "mug", ("duck", "mug"), np.array(p, np.float32), 0.003
    )
    return Decision("whiskers", model, "mount", made, 900, 2_000_900, UTC)


def samples(spec, values, t_ns=50, valid=None):
    """A chunk of one sample."""
    values = np.array(values, np.float32)[None]
    ok = np.ones(values.shape[:2], bool) if valid is None else np.array([valid])
    chunk = Chunk(np.array([3]), np.array([t_ns]), values, ok)
    return SourceChunk("whiskers", spec, chunk, t_ns, UTC)


def part(name, state="running", reason="", failures=0):
    return states.PartState(name, state, reason, 1, 1 + failures, failures)


def busy_snapshot(seconds=0, state="degraded"):
    """A daemon with something of everything."""
    at = 10_000_000_000 + seconds * 1_000_000_000
    queue = states.QueueState(
        {"samples": 1}, {"samples": 10, "events": 2}, {"samples": 7, "events": 2}, {"samples": 2},
        99,
    )  # fmt: skip
    latency = states.Latency(6, 0.035, 5.0, 9.5, 9.5, (0.001, 0.005, 0.01), (1, 2, 3, 0))
    return states.Snapshot(
        "1.2.3", 77, "/etc/robot.toml", at, UTC + at, 2_000_000_000, 1, state,
        ("no samples: source.finger: the device is lost",), 2,
        sources=(
            states.SourceState(
                part("source.whiskers"), "serial:///dev/ttyACM0", "mouse", "head", 1000.0,
                ("B1", "C2"), ("fx", "fy", "fz"), ("N", "N", "N"),
                Health(State.STREAMING, 1, connections=3, drift_ppm=12.5),
                SourceStats(5000, 4, 3, 2, 1), 5000 + 1000 * seconds, at - 4_000_000,
                measured_hz=998.0,
            ),
            states.SourceState(
                part("source.finger", failures=2), "can:slcan:/dev/ttyUSB0", 'fi"ng\\er', "tip",
                110.0, ("t",), ("fz",), ("N",), Health(State.LOST, 1, "unplugged"),
            ),
        ),
        models=(
            states.ModelState(
                part("model.whiskers"), "whiskers", "m.onnx", "ab" * 32, ("duck", "mug"), queue,
                40, 4, True, "mug", 0.93, latency, latency,
            ),
        ),
        consumers=(
            states.ConsumerState(
                part("publisher.zmq"), "zmq", queue, latency,
                {"endpoint": "tcp://127.0.0.1:5556", "messages": 40},
            ),
            states.ConsumerState(
                part("recorder", "waiting", "No space left on device", 9), "recorder",
                on_disk={
                    "whiskers": states.OnDisk(
                        at - 400_000_000, at - 900_000_000, 4000, meant_ns=at
                    )
                },
            ),
        ),
        diagnostics=(states.Diagnostic("source.finger", "no samples", "the device is lost"),),
        soon=(states.Diagnostic("recorder", "disk full soon", "it is full within 3 h"),),
    )  # fmt: skip


@contextlib.contextmanager
def running(consumer, view=None):
    view = view or View()
    consumer.open(view)
    try:
        yield view
    finally:
        consumer.close()
