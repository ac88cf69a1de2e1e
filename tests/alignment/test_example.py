"""The made-up brain: it is what it says, and other readers of NWB read its files."""

import json

import numpy as np
import pytest

from tactile_rt.alignment.example import MODELS, Brain, example_models
from tactile_rt.alignment.example_files import BEGIN_S, write_example
from tactile_rt.alignment.rdm import rsa
from tactile_rt.core.errors import ConfigError

h5py = pytest.importorskip("h5py")
SMALL = Brain(mice=2, sessions=1, units=6, trials=5)


def test_what_is_interrupted_leaves_nothing(tmp_path):
    def interrupted(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_example(tmp_path / "brain", SMALL, progress=interrupted)
    assert list(tmp_path.iterdir()) == []


def test_features_share_what_they_say():
    rng = np.random.default_rng(0)
    for private, lost in ((0.15, 0.0), (0.15, 0.5), (0.4, 0.25), (0.2, 1.0)):
        brain = Brain(private=private)
        shared = brain.geometry(rng)
        many = np.stack([brain.features(rng, shared, lost) for _ in range(4000)])
        kept = np.sqrt((1 - private) * (1 - lost))
        np.testing.assert_allclose(many.mean(axis=0), kept * shared, atol=0.06)
        assert (many**2).mean() == pytest.approx(1, abs=0.02)


def test_models_fit_less_the_more_they_lost():
    rng = np.random.default_rng(1)
    brain = Brain()
    fits = {name: [] for name in MODELS}
    for _ in range(40):
        shared = brain.geometry(rng)
        whole = brain.rates(rng, shared, 4000)
        for name, layers in example_models(brain, rng, shared).items():
            fits[name].append(rsa(whole, layers["encoder.layer3"]))
            assert abs(rsa(layers["encoder.layer0"], layers["encoder.layer3"])) < 0.9
    means = [np.mean(fits[name]) for name in MODELS]
    assert means == sorted(means, reverse=True)
    assert means[0] > 0.8 and abs(means[-1]) < 0.2


def test_recorded_trials_have_the_rates_that_were_drawn():
    rng = np.random.default_rng(2)
    brain = Brain(sessions=1, trials=4000, units=4)
    features = brain.geometry(rng)
    (session,) = brain.animal(np.random.default_rng(3), features, "m").sessions
    rates = brain.rates(np.random.default_rng(3), features, 4)
    means = [session.rates[session.stimulus == k].mean(axis=0) for k in range(6)]
    np.testing.assert_allclose(means, rates, rtol=0.05)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example") / "brain"
    return write_example(folder, SMALL, seed=3)


def test_pynwb_reads_the_sessions(written):
    pynwb = pytest.importorskip("pynwb")
    files = sorted(written[0].rglob("*.nwb"))
    assert len(files) == 2
    with pynwb.NWBHDF5IO(files[0], "r") as io:
        file = io.read()
        trials, units = file.trials.to_dataframe(), file.units.to_dataframe()
        assert file.subject.subject_id == "mouse-01"
        assert file.acquisition["extracellular array recording"].starting_time == BEGIN_S
        assert set(units) == {"depth", "inhibitory", "spike_times"} and len(units) == 6
        first = min(times[0] for times in units["spike_times"])
        tables = file.processing["behavior"].data_interfaces.items()
        touches = [t["start_time"][:] for name, t in tables if name.startswith("contacts")]
        touches = np.sort(np.concatenate(touches))
    # Spikes are on the session's clock: none before the electrical recording began.
    assert BEGIN_S <= first < BEGIN_S + 2
    correct = trials[trials.outcome == "correct"]
    shown = correct.stimulus + "-" + correct.servo_position
    assert shown.value_counts().tolist() == [5] * 6
    assert all(
        ((touches > t.start_time) & (touches < t.choice_time)).any() for t in trials.itertuples()
    )


def test_a_seed_makes_the_same_again(written, tmp_path):
    again = write_example(tmp_path / "again", SMALL, seed=3)
    other = write_example(tmp_path / "other", SMALL, seed=4)
    name = "sub-mouse-01/sub-mouse-01_ses-1_behavior+ecephys.nwb"
    spikes = []
    for recordings, _ in (written, again, other):
        with h5py.File(recordings / name) as file:
            spikes.append(file["units/spike_times"][()])
    np.testing.assert_array_equal(spikes[0], spikes[1])
    assert not np.array_equal(spikes[0], spikes[2])
    assert json.loads((again[0].parent / "truth.json").read_text())["seed"] == 3


def test_a_brain_that_cannot_be(tmp_path):
    for wrong in ({"mice": 0}, {"trials": 0}, {"private": 1.5}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            Brain(**wrong)
    with pytest.raises(ConfigError, match="already exists"):
        write_example(tmp_path, SMALL)
    with pytest.raises(ConfigError, match="seed must be 0 or more"):
        write_example(tmp_path / "x", SMALL, seed=-1)
