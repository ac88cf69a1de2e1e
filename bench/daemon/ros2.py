"""How old samples are in the hand of a ROS 2 node: 35 x 6 at 1 kHz, one message each, over DDS.

    python -m bench.daemon.ros2 --seconds 60

As in the daemon: one thread puts a chunk into the publisher's mailbox, the publisher's own thread
sends it. The node is a process of its own. A sample's age is from its making to the node's hand.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.daemon import ros2_node
from tactile_rt.core.stream import Chunk
from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.consumer import ConsumerPart
from tactile_rt.daemon.items import Opened, SourceChunk
from tactile_rt.daemon.publishers.ros2 import Ros2Options, Ros2Publisher
from tactile_rt.models.evaluation.records import Record, show
from tactile_rt.sources.synthetic import synthetic_spec

ELEMENTS, CHANNELS, RATE_HZ = 35, 6, 1000
BAR_MS = 2.0
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Ages:
    """What the node got.

    Attributes:
        sent: The number of samples that were put into the mailbox.
        seq: (n,) The numbers of those that came, in the order in which they came.
        age_ms: (n,) The age of each, ms.
    """

    sent: int
    seq: NDArray[np.int64]
    age_ms: NDArray[np.float64]

    @property
    def lost(self) -> int:
        """How many of those that were sent did not come."""
        return self.sent - len(np.unique(self.seq))

    def p99_ms(self) -> NDArray[np.float64]:
        """(second,) 99th percentile of each second by itself, ms."""
        seconds = self.seq // RATE_HZ
        return np.array([np.percentile(self.age_ms[seconds == s], 99) for s in np.unique(seconds)])


def free_domain() -> int:
    """A DDS domain that two of us do not have at the same time; beyond 100 the ports of a domain
    are those that the system gives out."""
    return 1 + os.getpid() % 100


class _Bare:
    """The daemon, as far as the publisher looks at it."""

    def __init__(self, streams: dict[str, Opened]) -> None:
        self._streams = streams

    def streams(self) -> dict[str, Opened]:
        return self._streams

    def report(self, part: str, state: str, reason: str, level: str = "info") -> None:
        if level == "error":
            raise RuntimeError(f"{part}: {state}: {reason}")


def measure(seconds: int) -> Ages:
    """Publish so long, and hear it in another process."""
    spec = synthetic_spec(ELEMENTS, CHANNELS, RATE_HZ)
    values = np.random.default_rng(0).normal(size=(1, *spec.shape)).astype(np.float32)
    valid, domain = np.ones(values.shape[:2], bool), free_domain()
    made = Ros2Publisher("ros2", Ros2Options(domain=domain, state_s=0))
    view: Any = _Bare({"array": Opened("array", spec, "", None, 0, 0)})  # type: ignore[arg-type]
    part = ConsumerPart("publisher.ros2", "ros2", made, view, view.report, LimitsConfig())

    def put(seq: int) -> None:
        now = time.monotonic_ns()
        chunk = Chunk(np.array([seq]), np.array([now]), values, valid)
        part.box.put(SourceChunk("array", spec, chunk, now, 0))

    part.start()
    with subprocess.Popen(
        [sys.executable, ros2_node.__file__, str(domain), "/tactile/array/samples"],
        stdout=subprocess.PIPE, text=True,
    ) as node:  # fmt: skip
        try:
            assert node.stdout is not None and node.stdout.readline() == "ready\n"
            _await_node(made)
            begin = time.monotonic()
            for seq in range(RATE_HZ * seconds):
                time.sleep(max(0.0, begin + seq / RATE_HZ - time.monotonic()))
                put(seq)
            put(-1)
            came = json.loads(node.communicate(timeout=PATIENCE_S)[0])
        finally:
            node.kill()
            part.stop()
            part.join(time.monotonic() + PATIENCE_S)
    table = np.array([c for c in came if c[0] >= 0], np.int64).reshape(-1, 3)
    return Ages(RATE_HZ * seconds, table[:, 0], (table[:, 2] - table[:, 1]) / 1e6)


def _await_node(made: Ros2Publisher) -> None:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if made.details()["nodes"]:
            return
        time.sleep(0.01)
    raise TimeoutError("the node was not found")


def ros2_records(seconds: int) -> list[Record]:
    """What `tactile-rt bench daemon` shows of it."""
    ages = measure(seconds)
    p50, p99, worst = np.percentile(ages.age_ms, [50, 99, 100])
    each = ages.p99_ms()
    told = f"p50 {p50:.2f}, worst {worst:.1f} ms; p99 of each second {each.min():.2f} to "
    told += f"{each.max():.2f}, median {np.median(each):.2f}"
    return [
        Record("daemon.ros2.age_p99", float(p99), "ms", f"<= {BAR_MS:g}", "", told),
        Record("daemon.ros2.lost", ages.lost, "samples", "== 0", "", f"of {ages.sent}"),
    ]


if __name__ == "__main__":
    from rich.console import Console

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60)
    show(ros2_records(parser.parse_args().seconds), Console())
