"""What `bench align` says that does not depend on who else uses the machine."""

from bench.align import area as alignment


def test_figures_that_are_no_times(monkeypatch):
    monkeypatch.setattr(alignment, "ANIMALS", 3)
    records = {r.name: r for r in alignment.run(quick=True)}
    for name in ("align.call_difference", "align.false_positives"):
        assert records[name].met, records[name]
    assert records["align.file"].value < 20
    assert 0 < records["align.p"].value <= 1
