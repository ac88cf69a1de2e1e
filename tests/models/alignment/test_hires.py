"""Graded touches, on files that pynwb wrote as the authors' exporter did."""

from datetime import UTC, datetime

import numpy as np
import pytest

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.datasets import find_dataset
from tactile_rt.models.alignment.metrics import find_metric
from tactile_rt.models.alignment.stimuli_input import read_stimuli

pytest.importorskip("pynwb")
pytest.importorskip("h5py")

FELT = read_stimuli()
HZ = 1000
TOUCHES, EVERY_S, LASTS_S = 120, 0.3, 0.03


def write(path, seed, mouse, tuning, touches=TOUCHES, flat=False):
    """A session of one cell whose rate after a touch follows its strength; the strengths."""
    import pynwb

    rng = np.random.default_rng(seed)
    file = pynwb.NWBFile("", f"{mouse}_{seed}", datetime(2010, 6, 19, tzinfo=UTC))
    file.subject = pynwb.file.Subject(subject_id=mouse, species="Mus musculus")
    device = file.create_device(name="Borosilicate glass")
    electrode = file.create_icephys_electrode(
        name="cell", device=device, description="N/A",
        location="brain_region: Barrel; cortical_layer: 4; depth: 512.0",
    )  # fmt: skip
    clock = np.arange(round((touches + 1) * EVERY_S * HZ)) / HZ
    onset = np.round((0.1 + EVERY_S * np.arange(touches)) * HZ).astype(int)
    strength = rng.permutation(np.linspace(-1, 1, touches))
    kappa = np.full(len(clock), np.nan)
    begins, ends = np.zeros(len(clock)), np.zeros(len(clock))
    probability = np.full(len(clock), 0.002)
    for at, s in zip(onset, strength, strict=True):
        inside = slice(at, at + round(LASTS_S * HZ))
        kappa[inside] = 0 if flat else s * np.hanning(round(LASTS_S * HZ) + 2)[1:-1]
        begins[at] = ends[at + round(LASTS_S * HZ)] = 1
        probability[at : at + 45] = tuning(s)
    spikes = (rng.random(len(clock)) < probability).astype(float)
    file.add_acquisition(pynwb.icephys.PatchClampSeries(
        name="SpikeTrain", electrode=electrode, unit="a.u.", gain=1.0, data=spikes,
        timestamps=clock, stimulus_description="N/A",
    ))  # fmt: skip
    series = [
        pynwb.TimeSeries(name=name, unit="a.u.", data=data, timestamps=clock)
        for name, data in (("touch_onset", begins), ("touch_offset", ends), ("delta_kappa", kappa))
    ]
    file.add_acquisition(pynwb.behavior.BehavioralTimeSeries(time_series=series, name="behavior"))
    with pynwb.NWBHDF5IO(path, "w") as io:
        io.write(file)
    return strength, spikes[onset[:, None] + np.arange(45)].sum(axis=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twelve cells of four mice, half of them tuned to bending in either direction."""
    home = tmp_path_factory.mktemp("hires")
    rng = np.random.default_rng(0)
    for k in range(12):
        best, gain = rng.uniform(-1.2, 1.2), rng.uniform(0.1, 0.3)
        write(home / f"cell-{k:02d}.nwb", k, f"anm{k % 4}",
              lambda s, b=best, g=gain: 0.005 + g * np.exp(-4 * (s - b) ** 2))  # fmt: skip
    return home


def read(paths):
    return find_dataset("000013").read(paths, FELT, lambda share: None)


def test_levels_and_rates(tmp_path):
    path = tmp_path / "cell.nwb"
    strength, counts = write(path, 1, "anm1", lambda s: 0.05 + 0.2 * (s > 0))
    contents = read([path])
    session = contents.animals[0].sessions[0]
    np.testing.assert_array_equal(session.stimulus, np.argsort(np.argsort(strength)) // 20)
    np.testing.assert_allclose(session.rates[:, 0], counts / 0.045)
    assert session.course.shape == (TOUCHES, 4, 1) and np.isfinite(session.course).all()
    assert session.animal == "anm1" and session.depth.tolist() == [512]


def test_bins_end_where_the_next_touch_begins(tmp_path):
    path = tmp_path / "cell.nwb"
    write(path, 1, "anm1", lambda s: 0.1)
    import h5py

    with h5py.File(path, "r+") as file:  # another touch 100 ms after the second: its third bin
        behavior = file["acquisition/behavior"]
        for name, at in (("touch_onset", 500), ("touch_offset", 520)):
            behavior[f"{name}/data"][at] = 1
    session = read([path]).animals[0].sessions[0]
    there = np.isfinite(session.course[..., 0])
    assert there.sum(axis=1).tolist() == [4, 2, *[4] * (TOUCHES - 1)]


def test_the_models_feel_the_mean_bending_at_one_whisker(folder):
    felt = read([folder]).stimuli
    place = felt.elements.index("C2"), felt.channels.index("mz")
    moved = felt.samples[..., place[0], place[1]].reshape(6, -1)
    others = felt.samples.copy()
    others[..., place[0], place[1]] = 0
    assert not others.any() and felt.sha256 != FELT.sha256
    assert not moved[:, 5:].any(), "nothing is felt after 30 ms, the fourth sample"
    peak = moved[np.arange(6), np.abs(moved).argmax(axis=1)]
    assert (np.diff(peak) > 0).all() and peak[0] < 0 < peak[-1]
    strongest = np.abs(FELT.samples[..., place[0], place[1]]).max()
    assert np.abs(moved).max() == pytest.approx(strongest, rel=1e-6)


def test_cells_of_all_mice_make_two_targets_that_can_be_measured_on(folder):
    contents = read([folder])
    assert [len(a.sessions) for a in contents.animals] == [6, 6]
    assert not {s.animal for s in contents.animals[0].sessions} & {
        s.animal for s in contents.animals[1].sessions
    }
    for name in ("rsa", "crossnobis", "cka", "linear"):
        ceilings = [find_metric(name)(animal).ceiling for animal in contents.animals]
        assert min(ceilings) > 0.5, name


def test_a_bad_file_drops_itself(folder, tmp_path):
    few, flat, text = tmp_path / "few.nwb", tmp_path / "flat.nwb", tmp_path / "text.nwb"
    write(few, 3, "anm9", lambda s: 0.1, touches=20)
    write(flat, 4, "anm9", lambda s: 0.1, flat=True)
    text.write_text("nothing")
    contents = read([folder, few, flat, text])
    said = " ".join(contents.notes)
    assert len(contents.notes) == 3 and sum(len(a.sessions) for a in contents.animals) == 12
    for words in ("few.nwb left out: 20 touches, and 24 are needed", "flat.nwb left out: no touch",
                  "text.nwb left out: it cannot be read"):  # fmt: skip
        assert words in said
    (tmp_path / "none").mkdir()
    for paths, wanted in (([few], "no cell can be used: few"), ([tmp_path / "none"], "no .nwb")):
        with pytest.raises(ConfigError, match=wanted):
            read(paths)


@pytest.mark.parametrize(
    "place, value",
    [
        ("general/intracellular_ephys", 1.0),
        ("acquisition/SpikeTrain/data", np.ones(3)),
        ("acquisition/behavior/delta_kappa/data", np.array(["a"] * 5, dtype="S1")),
        ("acquisition/behavior/touch_onset", np.zeros(4)),
    ],
)
def test_a_file_of_another_build_drops_itself_whatever_reading_it_raises(tmp_path, place, value):
    import h5py

    good, odd = tmp_path / "good.nwb", tmp_path / "odd.nwb"
    write(good, 1, "anm1", lambda s: 0.05 + 0.2 * (s > 0))
    odd.write_bytes(good.read_bytes())
    with h5py.File(odd, "r+") as file:
        del file[place]
        file[place] = value
    contents = read([odd, good])
    assert sum(len(a.sessions) for a in contents.animals) == 1
    (note,) = contents.notes
    assert note.startswith("odd.nwb left out: ") and "\n" not in note
