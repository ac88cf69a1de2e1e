"""Everything that `tactile-rt bench drivers` measures, in turn."""

from bench.drivers.clocks import clocks
from bench.drivers.consumers import consumers
from bench.drivers.fuzzing import fuzzing
from bench.drivers.losses import losses
from bench.drivers.recordings import recordings
from bench.drivers.unplugging import unplugging
from bench.drivers.wires import can, readers, serial
from tactile_rt.models.evaluation.records import Record

PARTS = (serial, readers, can, losses, unplugging, clocks, consumers, recordings, fuzzing)


def run(quick: bool) -> list[Record]:
    """Measure; quick: about a minute, else half an hour (two soaks of ten minutes)."""
    return [record for part in PARTS for record in part(quick)]
