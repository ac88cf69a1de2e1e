"""Everything that `tactile-rt bench drivers` measures, in turn."""

from tactile_rt.benchmarks.drivers.clocks import clocks
from tactile_rt.benchmarks.drivers.consumers import consumers
from tactile_rt.benchmarks.drivers.fuzzing import fuzzing
from tactile_rt.benchmarks.drivers.losses import losses
from tactile_rt.benchmarks.drivers.recordings import recordings
from tactile_rt.benchmarks.drivers.unplugging import unplugging
from tactile_rt.benchmarks.drivers.wires import can, serial
from tactile_rt.benchmarks.records import Record

__all__ = ["run"]

PARTS = (serial, can, losses, unplugging, clocks, consumers, recordings, fuzzing)


def run(quick: bool) -> list[Record]:
    """Measure; quick: about a minute, else half an hour (two soaks of ten minutes)."""
    return [record for part in PARTS for record in part(quick)]
