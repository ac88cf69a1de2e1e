"""What `bench align` says that does not depend on who else uses the machine."""

import pytest

from bench.align import area as alignment


def test_figures_that_are_no_times(monkeypatch):
    pytest.importorskip("rsatoolbox")
    pytest.importorskip("sklearn")
    monkeypatch.setattr(alignment, "ANIMALS", 3)
    records = {r.name: r for r in alignment.run(quick=True)}
    exact = [name for name in records if name.startswith("align.metric.")]
    assert len(exact) == 5
    for name in (
        "align.call_difference", "align.false_positives", "align.strict_moved", "align.paper_code",
        *exact,
    ):  # fmt: skip
        assert records[name].met, records[name]
    assert records["align.file"].value < 20
    assert 0 < records["align.p"].value <= 1
