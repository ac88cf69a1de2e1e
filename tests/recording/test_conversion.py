"""Recordings as npz, CSV and HDF5, and back: bit for bit, and read by others as documented."""

import csv
import itertools
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from tactile_rt.calibration import Calibration
from tactile_rt.errors import ConfigError, RecordingError
from tactile_rt.extras import install_extra
from tactile_rt.recording import Description, Recording, recover
from tactile_rt.recording.conversion import convert, outputs_of
from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.writer import McapFile
from tactile_rt.sources.opening import open_source
from tactile_rt.stream import Chunk, concatenate
from tactile_rt.testing import cut, small_spec

h5py = pytest.importorskip("h5py")

SPEC = small_spec()
FORMS = ["npz", "csv", "h5"]
TOPICS = ("samples", "decisions", "events", "health")
DOCS = Path(__file__).parents[2] / "docs"


def odd_chunks(seed=0):
    """Gaps, lost elements, all kinds of NaN, -0, numbers at the ends of what there is."""
    values = np.random.default_rng(seed).normal(size=(60, *SPEC.shape)).astype(np.float32)
    chunks = cut(values, 1000.0, samples=7, start_ns=123_456_789)
    values, valid = chunks[1].values.copy(), chunks[1].valid.copy()
    values[0, 0], values[1, 1] = np.nan, -0.0
    values[2, 2] = np.float32(1e-45), np.finfo(np.float32).max
    values[3, 1] = np.inf, -np.inf
    values.view(np.uint32)[4, 2] = 0xFFC01234, 0x7F800001  # NaN that carry something
    valid[0, 0] = valid[5, 1] = False
    chunks[1] = replace(chunks[1], values=values, valid=valid)
    chunks[3:] = [replace(c, seq=c.seq + 10**15, t_ns=c.t_ns + 2**60) for c in chunks[3:]]
    chunks[5] = Chunk(*(getattr(chunks[5], n)[:1] for n in ("seq", "t_ns", "values", "valid")))
    return chunks


def described(**changes):
    return replace(
        Description(
            SPEC, 1_700_000_000_123_456_789, "serial:x", codec="native", clock="device",
            calibration=replace(Calibration.of("it", SPEC), gain=(2.0, 1.5)),
            session={"who": "Ada\n\u2028", "daemon_source": "left"},
        ),
        **changes,
    )  # fmt: skip


def write(path, chunks, about=None):
    """A recording with everything; when things were recorded is not when they happened."""
    about = about or described()
    with path.open("wb") as file:
        made = McapFile(file, about)
        for k, chunk in enumerate(chunks):
            made.add("samples", encode_samples(chunk), int(chunk.t_ns[-1]) + 777 * k)
            text = {"type": "decision", "label": f"m\u00fcg \u2028 {k}\n", "p": 0.1 * k}
            made.add("decisions", msgspec.json.encode(text), int(chunk.t_ns[-1]) - 10**9)
        made.add("events", b'{"type": "contact",  "touching": true}', 5)
        made.add("health", b"{}", 2**60)
        made.finish()
    return path


def messages(path):
    return {t: [(raw.t_ns, raw.data) for raw in Recording(path).raw(t)] for t in TOPICS}


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "run.mcap", odd_chunks())


# there and back


@pytest.mark.parametrize("form", FORMS)
def test_what_goes_there_comes_back(form, path, tmp_path):
    there, back = tmp_path / f"x.{form}", tmp_path / "back.mcap"
    n = sum(map(len, odd_chunks()))
    assert convert(path, there) == convert(there, back) == n
    assert messages(back) == messages(path)
    assert Recording(back).description == Recording(path).description
    with open_source(f"replay:{path}?speed=0") as one, open_source(f"replay:{back}?speed=0") as two:
        assert [encode_samples(c) for c in one] == [encode_samples(c) for c in two]


def test_through_all_forms_in_turn(path, tmp_path):
    names = ["a.npz", "b.h5", "c.csv", "d.hdf5", "e.npz", "f.mcap"]
    files = [path, *(tmp_path / name for name in names)]
    for one, other in itertools.pairwise(files):
        convert(one, other)
    assert messages(files[-1]) == messages(path)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    bits=arrays_of.arrays(np.uint32, st.tuples(st.integers(1, 6), st.just(3), st.just(2))),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_bits_of_any_sample_come_back(bits, seed, tmp_path):
    draw = np.random.default_rng(seed)
    n = len(bits)
    seq = np.sort(draw.integers(-(2**62), 2**62, n))
    chunk = Chunk(seq, seq[::-1].copy(), bits.view(np.float32), draw.random((n, 3)) < 0.7)
    path = write(tmp_path / "any.mcap", [chunk], described(utc_offset_ns=2**62))
    for form in FORMS:
        there, back = tmp_path / f"any.{form}", tmp_path / "back.mcap"
        convert(path, there)
        convert(there, back)
        assert messages(back) == messages(path)


def test_text_gives_back_every_number(tmp_path):
    bits = np.random.default_rng(7).integers(0, 2**32, (4000, 3, 2), np.uint32)
    (chunk,) = cut(bits.view(np.float32), 1000.0, samples=4000)
    path = write(tmp_path / "run.mcap", [chunk])
    convert(path, tmp_path / "x.csv")
    convert(tmp_path / "x.csv", tmp_path / "back.mcap")
    (back,) = Recording(tmp_path / "back.mcap")
    assert back.values.tobytes() == bits.tobytes()


def test_a_recovered_recording_stays_one(path, tmp_path):
    path.write_bytes(path.read_bytes()[:-40])
    mended = recover(path)
    convert(mended, tmp_path / "x.h5")
    convert(tmp_path / "x.h5", tmp_path / "back.mcap")
    assert Recording(tmp_path / "back.mcap").description.recovered


def test_packets_stay_behind_and_that_is_said(tmp_path):
    path = write(tmp_path / "run.mcap", odd_chunks(), described(wire="serial"))
    convert(path, tmp_path / "x.npz")
    convert(tmp_path / "x.npz", tmp_path / "back.mcap")
    assert Recording(tmp_path / "back.mcap").description.codec == "native"
    with pytest.raises(ConfigError, match="has no raw packets"):
        open_source(f"replay:{tmp_path / 'back.mcap'}?from=wire")


def test_large_recordings_are_cut_as_they_were(tmp_path):
    sizes = np.random.default_rng(1).integers(1, 4000, 30)
    values = np.random.default_rng(2).normal(size=(int(sizes.sum()), 3, 2))
    (whole,) = cut(values, 1000.0, samples=len(values))
    ends = np.cumsum(sizes)
    columns = [np.split(getattr(whole, n), ends[:-1]) for n in ("seq", "t_ns", "values", "valid")]
    path = write(tmp_path / "run.mcap", [Chunk(*c) for c in zip(*columns, strict=True)])
    convert(path, tmp_path / "x.h5")
    convert(tmp_path / "x.h5", tmp_path / "back.mcap")
    assert messages(tmp_path / "back.mcap") == messages(path)


# as others read it


def test_arrays_are_as_documented(path, tmp_path):
    convert(path, tmp_path / "x.npz")
    whole = concatenate(odd_chunks())
    with np.load(tmp_path / "x.npz") as found:  # no pickle
        for name in ("seq", "t_ns", "values", "valid"):
            assert found[name].dtype == getattr(whole, name).dtype
            assert found[name].tobytes() == getattr(whole, name).tobytes()
        assert int(found["utc_offset_ns"]) == 1_700_000_000_123_456_789
        assert SPEC.from_json(str(found["spec"])) == SPEC
        lines = found["decisions"].tobytes().decode().split("\n")[:-1]
    assert [json.loads(line)["label"] for line in lines][3] == "m\u00fcg \u2028 3\n"


def test_text_is_as_documented(path, tmp_path):
    convert(path, tmp_path / "x.csv")
    whole = concatenate(odd_chunks())
    with (tmp_path / "x.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == [
        "seq", "t_ns", "A0.fy [N]", "A0.mz [N m]", "A1.fy [N]", "A1.mz [N m]", "A2.fy [N]",
        "A2.mz [N m]", "bits",
    ]  # fmt: skip
    assert len(rows) == len(whole)
    for i, (seq, t_ns, *cells, _) in enumerate(rows):
        assert (int(seq), int(t_ns)) == (whole.seq[i], whole.t_ns[i])
        for j, cell in enumerate(cells):
            element, channel = divmod(j, 2)
            value = whole.values[i, element, channel]
            if not whole.valid[i, element]:
                assert cell == ""
            else:
                assert np.array_equal(np.float32(cell), value, equal_nan=True)
    assert rows[7][-1] == "0:0000c07f0000c07f"
    assert [row[-1] != "" for row in rows].count(True) == 3
    beside = json.loads((tmp_path / "x.csv.json").read_text("utf-8"))
    assert beside["decisions"][0]["p"] == 0
    assert outputs_of(tmp_path / "x.csv") == [tmp_path / "x.csv", tmp_path / "x.csv.json"]


def test_the_example_reads_hdf5(path, tmp_path, monkeypatch):
    convert(path, tmp_path / "run.h5")
    monkeypatch.chdir(tmp_path)
    (text,) = re.findall(
        r"```python\n(import h5py.*?)```", (DOCS / "reference" / "recording.md").read_text(), re.S
    )
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


def test_arrays_of_one_s_own_become_a_recording(tmp_path):
    (whole,) = cut(np.ones((30, *SPEC.shape)), 1000.0, samples=30)
    own = {name: getattr(whole, name) for name in ("seq", "t_ns", "values", "valid")}
    np.savez(tmp_path / "own.npz", **own, spec=SPEC.to_json())
    assert convert(tmp_path / "own.npz", tmp_path / "own.mcap") == 30
    assert [len(c) for c in Recording(tmp_path / "own.mcap")] == [9, 9, 9, 3]
    assert Recording(tmp_path / "own.mcap").description.spec == SPEC
    for name, wrong, said in (
        ("values", own["values"][:, :2], r"values is float32 \(30, 2, 2\), not .* \(30, 3, 2\)"),
        ("t_ns", own["t_ns"].astype(float), r"t_ns is float64 \(30,\), not int64"),
        ("spec", "{}", "spec: "),
    ):
        np.savez(tmp_path / "own.npz", **{**own, "spec": SPEC.to_json(), name: wrong})
        with pytest.raises(RecordingError, match=said):
            convert(tmp_path / "own.npz", tmp_path / "not.mcap")
    np.savez(tmp_path / "own.npz", **own)
    with pytest.raises(RecordingError, match="does not say what array it is of"):
        convert(tmp_path / "own.npz", tmp_path / "not.mcap")
    np.savez(tmp_path / "own.npz", seq=own["seq"], spec=SPEC.to_json())
    with pytest.raises(RecordingError, match="holds no t_ns, values, valid"):
        convert(tmp_path / "own.npz", tmp_path / "not.mcap")
    assert not (tmp_path / "not.mcap").exists()


# damage and mistakes


@pytest.mark.parametrize("form", FORMS)
def test_damage_is_named_and_nothing_half_written(form, path, tmp_path):
    there = tmp_path / f"x.{form}"
    convert(path, there)
    data = there.read_bytes()
    before = sorted(p.name for p in tmp_path.iterdir())
    for keep in (0, 1, len(data) // 3, len(data) - len(data) // 5):
        there.write_bytes(data[:keep])
        with pytest.raises(RecordingError, match=re.escape(str(there))) as caught:
            convert(there, tmp_path / "back.mcap")
        assert "\n" not in str(caught.value)
        assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("A1.fy", "B1.fy"), "x.csv:1: these are not the columns of small"),
        (lambda t: t.replace("\n3,", "\n3,7,", 1), "x.csv:5: 10 columns, not 9"),
        (lambda t: t.replace("\n3,", "\nthree,", 1), "x.csv: lines 2 to .*three"),
        (lambda t: t.replace("0:0000c07f0000c07f", "9:0000c07f0000c07f"), "lines 2 to"),
        (lambda t: t.replace("0:0000c07f0000c07f", "0:00"), "lines 2 to"),
        (lambda t: t.rpartition("\n")[0].rpartition("\n")[0] + "\n", r"chunks of .* samples for"),
    ],
)
def test_text_that_was_edited_wrongly_is_named(change, said, path, tmp_path):
    file = tmp_path / "x.csv"
    convert(path, file)
    file.write_text(change(file.read_text("utf-8")), "utf-8")
    with pytest.raises(RecordingError, match=said):
        convert(file, tmp_path / "back.mcap")
    assert not (tmp_path / "back.mcap").exists()


def test_text_without_what_is_beside_it_is_named(path, tmp_path):
    convert(path, tmp_path / "x.csv")
    (tmp_path / "x.csv.json").write_text("{")
    with pytest.raises(RecordingError, match=r"x.csv.json is damaged"):
        convert(tmp_path / "x.csv", tmp_path / "back.mcap")
    (tmp_path / "x.csv.json").unlink()
    with pytest.raises(
        ConfigError,
        match=r"no .*x.csv.json, which says .*`tactile-rt import` reads",
    ):
        convert(tmp_path / "x.csv", tmp_path / "back.mcap")


@pytest.mark.parametrize("form", FORMS)
def test_a_recording_without_samples_is_refused(form, tmp_path):
    path = write(tmp_path / "run.mcap", [])
    with pytest.raises(RecordingError, match=r"run\.mcap has no samples"):
        convert(path, tmp_path / f"x.{form}")
    assert list(tmp_path.iterdir()) == [path]


def test_without_the_extra_it_says_what_to_install(path, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    for one, other in ((path, tmp_path / "x.h5"), (tmp_path / "x.h5", tmp_path / "y.npz")):
        with pytest.raises(
            ConfigError, match=f"HDF5 needs h5py, .*: {re.escape(install_extra('hdf5'))}"
        ):
            convert(one, other)
    assert convert(path, tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("run.mcap", "x.txt"), r"x.txt is neither .mcap nor .npz, .csv, .h5, .hdf5"),
        (("x.wav", "x.npz"), "x.wav is neither"),
        (("run.mcap", "y.mcap"), "is a recording already"),
        (("none.h5", "y.mcap"), "no file .*none.h5"),
    ],
)
def test_wrong_names_are_named(names, said, path, tmp_path):
    with pytest.raises(ConfigError, match=said):
        convert(*(tmp_path / name for name in names))
