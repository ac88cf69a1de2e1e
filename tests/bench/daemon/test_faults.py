"""Every fault of the daemon's world once; `bench faults` causes each 40 times."""

import pytest

faults = pytest.importorskip("bench.daemon.faults")


@pytest.mark.slow
@pytest.mark.alone
def test_each_fault_is_told_rightly_and_soon_and_no_longer_than_it_lasts():
    wrong = [f"{r.name}: {r.anchor}" for r in faults.faults(1) if not r.met]
    assert not wrong, "\n".join(wrong)
