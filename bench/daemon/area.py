"""Everything that `tactile-rt bench daemon` measures, in turn."""

from bench.daemon.kills import kill_nine
from bench.daemon.overload import overload
from bench.daemon.power import power_cuts
from bench.daemon.ros2 import ros2_records
from bench.daemon.soak import soak_records
from bench.daemon.soak_rig import QUICK_S, WHOLE_S, soak
from tactile_rt.models.evaluation.records import Record


def run(quick: bool) -> list[Record]:
    """Measure; quick: two minutes, else half an hour."""
    records = soak_records(soak(QUICK_S if quick else WHOLE_S))
    records += [*kill_nine(quick), *power_cuts(quick), *overload(quick)]
    records += ros2_records(5 if quick else 60)
    return records
