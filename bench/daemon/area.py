"""Everything that `tactile-rt bench daemon` measures, in turn."""

from bench.daemon.chaos import chaos
from bench.daemon.kills import kill_nine
from bench.daemon.soak import QUICK_S, WHOLE_S, soak
from bench.daemon.soak_figures import soak_records
from tactile_rt.evidence.records import Record

__all__ = ["run"]


def run(quick: bool) -> list[Record]:
    """Measure; quick: two minutes, else half an hour."""
    records = soak_records(soak(QUICK_S if quick else WHOLE_S))
    return [*records, *chaos(quick), *kill_nine(quick)]
