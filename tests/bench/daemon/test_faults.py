"""Every fault of the daemon's world once; `bench faults` causes each 40 times."""

import pytest

pytest.importorskip("zmq")
pytest.importorskip("onnx")
faults = pytest.importorskip("bench.daemon.faults")

MOST_SHARE = 0.6  # of a core, undisturbed: beyond, a reload alone costs decisions


@pytest.mark.slow
@pytest.mark.alone
def test_each_fault_is_told_rightly_and_soon_and_no_longer_than_it_lasts():
    if (share := faults.measure_share()) > MOST_SHARE:
        pytest.skip(f"its limits are for faster machines: the daemon takes {share:.0%} of a core")
    wrong = [f"{r.name}: {r.anchor}" for r in faults.faults(1) if not r.met]
    assert not wrong, "\n".join(wrong)
