"""Recordings of any named stimuli: archives of rates, tables of spikes and events."""

import numpy as np
import pytest

from tactile_rt.alignment import build, score
from tactile_rt.alignment.named_recordings import read_named_npz, read_spike_tables
from tactile_rt.alignment.rdm import relabellings
from tactile_rt.core.errors import ConfigError

NAMES = [f"texture {k}" for k in range(9)]


def arrays(animals=6, trials=12, names=NAMES, seed=0):
    """Rates that follow features which all animals share, and noise."""
    rng = np.random.default_rng(seed)
    shared, found = rng.normal(size=(len(names), 4)), {}
    for k in range(animals):
        shown = np.repeat(np.arange(len(names)), trials)
        rates = shared[shown] @ rng.normal(size=(4, 30)) + 8
        found[f"m{k}/day 1/rates"] = np.abs(rates + rng.normal(size=rates.shape))
        found[f"m{k}/day 1/stimulus"] = np.array(names)[shown]
    return shared, found


def test_an_archive_of_nine_stimuli_is_built_and_scored(tmp_path):
    shared, found = arrays()
    np.savez(tmp_path / "mine.npz", **found)
    benchmark = build([tmp_path / "mine.npz"], bootstraps=20)
    assert benchmark.stimuli == tuple(NAMES) and len(benchmark.reliable) == 6
    assert benchmark.a2a.mean > 0.8
    rng = np.random.default_rng(1)
    good = score(benchmark, {"encoder.a": shared @ rng.normal(size=(4, 100))})
    bad = score(benchmark, {"encoder.a": rng.normal(size=(9, 100))})
    assert good.score > 0.8 > 0.4 > bad.score and good.p < 0.001 < bad.p
    assert len(relabellings(9)) == 5000  # drawn, the stimuli as they are among them
    assert (relabellings(9)[0] == np.arange(36)).all()


def test_tables_of_spikes_and_events_give_the_same_rates_as_counting(tmp_path):
    rng = np.random.default_rng(0)
    spikes, events, counts = (
        ["animal,session,unit,time_s"],
        ["session,animal,stimulus,start_s,stop_s"],
        [],
    )
    for k in range(24):
        events.append(f"s,a,{'abc'[k % 3]},{k},{k + 0.5}")
        counts.append(rng.integers(0, 9, size=4))
        for unit, n in enumerate(counts[-1]):
            spikes += [f"a,s,u{unit},{k + 0.5 * f:.4f}" for f in rng.random(n) * 0.99]
            spikes.append(f"a,s,u{unit},{k + 0.7}")  # between trials
    (tmp_path / "s.csv").write_text("\n".join(spikes))
    (tmp_path / "e.csv").write_text("\n".join(events))
    (session,) = read_spike_tables([tmp_path / "e.csv", tmp_path / "s.csv"])
    np.testing.assert_allclose(session.rates, 2 * np.array(counts))
    assert session.stimuli == ("a", "b", "c") and session.trials.tolist() == [8, 8, 8]
    (tmp_path / "e.csv").write_text("\n".join(events).replace("s,a,a,0,0.5", "s,a,a,0.5,0"))
    with pytest.raises(ConfigError, match=r"e\.csv:2: stop_s 0 is not after"):
        read_spike_tables([tmp_path / "e.csv", tmp_path / "s.csv"])


@pytest.mark.parametrize(
    "change, refusal",
    [
        ({"m0/day 1/stimulus": np.array(["a"])}, r"m0/day 1/stimulus is \(1,\), not \(108,\)"),
        ({"m0/rates": np.ones((2, 2))}, "array m0/rates is none of"),
        ({"m0/day 1/type": np.array(["pyramid"] * 30)}, "pyramid is none of"),
        ({"m0/day 1/rates": -np.ones((108, 30))}, "rates below 0"),
    ],
)
def test_what_an_archive_cannot_hold_is_refused_by_name(tmp_path, change, refusal):
    np.savez(tmp_path / "mine.npz", **{**arrays(1)[1], **change})
    with pytest.raises(ConfigError, match=refusal) as caught:
        read_named_npz(tmp_path / "mine.npz")
    assert len(str(caught.value)) <= 200 + len(str(tmp_path))
