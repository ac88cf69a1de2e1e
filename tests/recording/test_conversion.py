"""Recordings as npz, CSV and HDF5: bit for bit, and read by others as documented."""

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.calibration import Calibration
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.packages import install_extra
from tactile_rt.core.stream import Chunk, concatenate
from tactile_rt.recording import Description, Recording
from tactile_rt.recording.conversion import convert
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.recordings import odd_chunks, write_as_daemon

h5py = pytest.importorskip("h5py")

SPEC = small_spec()
FORMS = ["npz", "csv", "h5"]
TOPICS = ("samples", "decisions", "events", "health")
DOCS = Path(__file__).parents[2] / "docs"


def write(path, chunks):
    about = Description(
        SPEC, 1_700_000_000_123_456_789, "serial:x", codec="native", clock="device",
        calibration=replace(Calibration.of("it", SPEC), gain=(2.0, 1.5)),
        session={"who": "Ada\n\u2028", "daemon_source": "left"},
    )  # fmt: skip
    return write_as_daemon(path, about, chunks)


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "run.mcap", odd_chunks())


def read_back(path):
    """Samples and messages of an .npz or .h5, in the types that are documented."""
    if path.suffix == ".npz":
        with np.load(path) as found:  # no pickle
            arrays = {name: found[name] for name in found.files}
        texts = {t: arrays[t].tobytes().decode().split("\n")[:-1] for t in TOPICS[1:]}
        assert SPEC.from_json(str(arrays["spec"])) == SPEC
        return arrays, texts, str(arrays["about"])
    with h5py.File(path) as file:
        texts = {topic: list(file[topic].asstr()) for topic in TOPICS[1:]}
        names = [name for name in file if name not in (*texts, "about")]
        return {name: file[name][:] for name in names}, texts, file["about"].asstr()[()]


@pytest.mark.parametrize("form", ["npz", "h5"])
def test_arrays_hold_samples_and_messages_bit_for_bit(form, path, tmp_path):
    whole = concatenate(odd_chunks())
    assert convert(path, tmp_path / f"x.{form}") == len(whole)
    arrays, texts, about = read_back(tmp_path / f"x.{form}")
    for name in ("seq", "t_ns", "values", "valid"):
        assert arrays[name].dtype == getattr(whole, name).dtype
        assert arrays[name].tobytes() == getattr(whole, name).tobytes()
    for topic in TOPICS[1:]:
        times = arrays[f"{topic}_log_ns"].tolist()
        found = zip(times, (text.encode() for text in texts[topic]), strict=True)
        assert list(found) == [(raw.t_ns, raw.data) for raw in Recording(path).raw(topic)]
    assert len(texts["decisions"]) > 5 and texts["health"]
    fields = json.loads(about)
    made = Description.from_metadata("x", fields["tactile_rt"], fields["session"], False)
    assert made == Recording(path).description


def test_an_array_of_many_blocks_is_whole_in_hdf5(tmp_path):
    (whole,) = cut_chunks(
        np.random.default_rng(2).normal(size=(60_000, 3, 2)), 1000.0, samples=60_000
    )
    columns = [np.split(getattr(whole, n), 30) for n in ("seq", "t_ns", "values", "valid")]
    path = write(tmp_path / "run.mcap", [Chunk(*c) for c in zip(*columns, strict=True)])
    convert(path, tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5") as file:
        assert file["values"][:].tobytes() == whole.values.tobytes()


def test_text_gives_back_every_valid_number(path, tmp_path):
    convert(path, tmp_path / "x.csv")
    whole = concatenate(odd_chunks())
    with (tmp_path / "x.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    loads = [f"A{k}.{load}" for k in range(3) for load in ("fy [N]", "mz [N m]")]
    assert head == ["seq", "t_ns", *loads]
    assert np.array([row[:2] for row in rows], np.int64).T.tolist() == [[*whole.seq], [*whole.t_ns]]
    cells = np.array([row[2:] for row in rows]).reshape(whole.values.shape)
    assert np.array_equal((cells != "").all(axis=2), whole.valid)
    found = cells[whole.valid].astype(np.float32)
    assert np.array_equal(found, whole.values[whole.valid], equal_nan=True)


def test_the_example_reads_hdf5(path, cwd):
    convert(path, cwd / "run.h5")
    page = (DOCS / "reference" / "recording.md").read_text()
    (text,) = re.findall(r"```python\n(import h5py.*?)```", page, re.S)
    assert len([line for line in text.splitlines() if line]) == 6
    found = {}
    exec(text, found)
    whole = concatenate(odd_chunks())
    for name in ("values", "t_ns", "valid"):
        assert found[name].tobytes() == getattr(whole, name).tobytes()
    assert list(found["elements"]) == list(SPEC.elements)
    assert list(found["units"]) == list(SPEC.units)
    assert found["frame"] == SPEC.frame
    assert found["decisions"][2]["p"] == 0.2


@pytest.mark.parametrize("form", FORMS)
def test_a_recording_without_samples_is_refused(form, tmp_path):
    path = write(tmp_path / "run.mcap", [])
    with pytest.raises(RecordingError, match=r"run\.mcap has no samples"):
        convert(path, tmp_path / f"x.{form}")
    assert list(tmp_path.iterdir()) == [path]


def test_without_the_extra_it_says_what_to_install(path, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    said = f"HDF5 needs h5py, .*: {re.escape(install_extra('hdf5'))}"
    with pytest.raises(ConfigError, match=said):
        convert(path, tmp_path / "x.h5")
    assert convert(path, tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("run.mcap", "x.txt"), r"x.txt is none of .npz, .csv, .h5, .hdf5"),
        (("run.mcap", "y.mcap"), "y.mcap is none of .*`tactile-rt import`"),
        (("none.mcap", "y.npz"), "no recording .*none.mcap"),
    ],
)
def test_wrong_names_are_named(names, said, path, tmp_path):
    with pytest.raises(ConfigError, match=said):
        convert(*(tmp_path / name for name in names))
