"""Offsets, matrices, mirrors and their files, against numpy, cross products and the hand."""

import copy
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.calibration import (
    CalibratedSource,
    Calibration,
    Mirror,
    calibrate,
    calibration_path,
    load_calibration,
    median_readings,
    read_loads,
    save_calibration,
    tare,
)
from tactile_rt.core.errors import ConfigError, SourceError, SpecMismatch
from tactile_rt.core.stream import ArraySpec, Chunk, EndOfStream, SourceStats
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.refusals import refusal

AXES = ("fx", "fy", "fz", "mx", "my", "mz")
LOADS = ("N",) * 3 + ("N m",) * 3
ELEMENTS = ("A0", "A1", "A2")
GAUGES = tuple(f"s{i}" for i in range(6))


def gauge_spec(elements: int = 3, channels: tuple[str, ...] = GAUGES) -> ArraySpec:
    """Elements in a row with strain gauges, in counts."""
    return replace(
        small_spec(elements), channels=channels, units=("1",) * len(channels), name="gauges"
    )


def chunk_of(values: np.ndarray, valid: np.ndarray | None = None) -> Chunk:
    (whole,) = cut_chunks(values, 1000.0, samples=len(values))
    return whole if valid is None else replace(whole, valid=valid)


def rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def calibration_of(device: str = "d", **fields: object) -> Calibration:
    """Make a calibration of three elements, from gauges to loads."""
    return Calibration(device, ELEMENTS, GAUGES, ("1",) * 6, AXES, LOADS, **fields)


def whole_calibration(rng: np.random.Generator) -> Calibration:
    """One that uses all there is."""
    return calibration_of(
        "bench-7",
        gain=(1e-6, 2e-6, 3e-6, 1e-9, 2e-9, 3e-9),
        tare={"A0": tuple(rng.normal(size=6).tolist()), "A2": (1.0, -2.0, 0.0, 1e-300, 3.5, 1e22)},
        noise={"A0": (0.1,) * 6},
        changes=0.875,
        matrices={"A2": rows(rng.normal(size=(6, 6)))},
        mapping={"C2": "A2", "weird name\n\"'\\ü\x7f": "A0"},
        mirror=Mirror("y", "x", {"fx": 1}),
        history=("2026-11-21 tare", 'with "quotes"'),
    )


# ---- applying


def test_every_element_is_its_matrix_times_raw_less_tare() -> None:
    rng = np.random.default_rng(1)
    raw = rng.normal(size=(50, 3, 6)) * 1e4
    offsets, matrices = rng.normal(size=(3, 6)) * 1e4, rng.normal(size=(3, 6, 6)) * 1e-6
    calibration = calibration_of(
        tare={f"A{e}": tuple(offsets[e]) for e in range(3)},
        matrices={f"A{e}": rows(matrices[e]) for e in range(3)},
    )
    chunk = chunk_of(raw)
    before = chunk.values.copy()
    made = calibration.apply(chunk)
    for n in range(50):
        for e in range(3):
            expected = matrices[e] @ (raw[n, e] - offsets[e])
            np.testing.assert_allclose(made.values[n, e], expected, rtol=0, atol=2e-8)
    assert made.values.dtype == np.float32
    assert made.valid.all()
    assert np.array_equal(made.seq, chunk.seq)
    assert np.array_equal(made.t_ns, chunk.t_ns)
    assert np.array_equal(chunk.values, before), "the raw chunk is left as it was"
    spec = calibration.output_spec(gauge_spec())
    assert (spec.channels, spec.units) == (AXES, LOADS)
    assert spec.positions == gauge_spec().positions


def test_a_gain_is_a_diagonal_matrix() -> None:
    raw = np.random.default_rng(4).normal(size=(7, 3, 6))
    gain = (1.0, 2.0, -3.0, 4.0, 0.5, 0.0)
    by_gain = calibration_of(gain=gain)
    by_matrix = calibration_of(matrices=dict.fromkeys(ELEMENTS, rows(np.diag(gain))))
    # one element's full matrix sends all of them the general way
    mixed = replace(by_gain, matrices={"A1": rows(np.ones((6, 6)))})
    expected = (raw * gain).astype(np.float32)
    for calibration in (by_gain, by_matrix):
        np.testing.assert_allclose(calibration.apply(chunk_of(raw)).values, expected, rtol=1e-6)
    made = mixed.apply(chunk_of(raw)).values
    np.testing.assert_allclose(made[:, [0, 2]], expected[:, [0, 2]], rtol=1e-6)
    np.testing.assert_allclose(made[:, 1], raw[:, 1].sum(axis=1)[:, None] * np.ones(6), atol=1e-5)


def test_counts_without_a_matrix_are_never_valid_newtons() -> None:
    calibration = calibration_of(matrices={"A1": rows(np.eye(6))})
    made = calibration.apply(chunk_of(np.ones((4, 3, 6))))
    assert made.valid.tolist() == [[False, True, False]] * 4
    assert calibration.uncalibrated == ("A0", "A2")


def test_invalid_stays_invalid_and_touches_no_neighbour() -> None:
    raw = np.ones((5, 3, 6))
    raw[1, 0], raw[2, 1], raw[3, 1, 2] = np.nan, np.inf, -np.inf
    valid = np.isfinite(raw).all(axis=2)
    valid[4, 2] = False
    matrix = rows(np.random.default_rng(6).normal(size=(6, 6)))
    calibration = calibration_of(matrices=dict.fromkeys(ELEMENTS, matrix))
    made = calibration.apply(chunk_of(raw, valid))
    assert np.array_equal(made.valid, valid)
    assert np.isfinite(made.values[valid]).all()


def test_an_output_beyond_float32_is_not_valid() -> None:
    calibration = replace(Calibration.of("d", small_spec()), gain=(1e30, 1.0))
    made = calibration.apply(chunk_of(np.array([[[1e30, 1.0], [1.0, 1.0], [0.0, 0.0]]])))
    assert made.valid.tolist() == [[False, True, True]]


def test_a_mapping_reorders_renames_and_leaves_out() -> None:
    spec = small_spec()
    calibration = replace(
        Calibration.of("d", spec),
        mapping={"C2": "A2", "C1": "A0"},
        tare={"A0": (10.0, 0.0), "A2": (0.0, 20.0)},
    )
    raw = np.arange(6.0).reshape(1, 3, 2)
    valid = np.array([[True, True, False]])
    made = calibration.apply(chunk_of(raw, valid))
    assert made.values.tolist() == [[[4.0, -15.0], [-10.0, 1.0]]]
    assert made.valid.tolist() == [[False, True]]
    mapped = calibration.output_spec(spec)
    assert mapped.elements == ("C2", "C1")
    assert mapped.grid == (spec.grid[2], spec.grid[0])
    assert mapped.positions == (spec.positions[2], spec.positions[0])


def test_samples_of_another_shape_are_refused() -> None:
    calibration = Calibration.of("left-hand", small_spec())
    with pytest.raises(SpecMismatch, match=r"left-hand is for samples of \(3, 2\)"):
        calibration.apply(chunk_of(np.zeros((1, 2, 2))))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"elements": ("A0", "A2", "A1")}, "for elements A0, A1, A2; small has A0, A2, A1"),
        ({"channels": ("fy", "mx")}, "for channels fy, mz; small has fy, mx"),
        ({"units": ("1", "1")}, "for units N, N m; small has 1, 1"),
    ],
)
def test_another_array_is_refused(changes: dict[str, tuple[str, ...]], what: str) -> None:
    with pytest.raises(SpecMismatch, match=what):
        Calibration.of("d", small_spec()).output_spec(replace(small_spec(), **changes))


# ---- mirroring


def rotation(quaternion: tuple[float, ...]) -> np.ndarray:
    """(3, 3) of a unit quaternion, by the textbook."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


numbers = st.floats(-10, 10, allow_subnormal=False)
points = st.tuples(numbers, numbers, numbers)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: tuple((np.array(q) / np.linalg.norm(q)).tolist()))
)
mirrors = st.builds(Mirror, st.sampled_from("xyz"), st.sampled_from("xyz"))


def posed(position: tuple[float, ...], orientation: tuple[float, ...]) -> ArraySpec:
    return ArraySpec(
        "one", ("A0",), ((0, 0),), (position,), (orientation,), AXES, LOADS, 1000.0, "mount"
    )


@given(mirrors, points, quaternions, points, points)
def test_a_mirrored_sensor_feels_the_mirrored_world(mirror, position, orientation, at, force):
    """Force and moment are taken in the mount frame there and here, with plain cross products."""
    spec = posed(position, orientation)
    calibration = replace(Calibration.of("d", spec), mirror=mirror)
    turn = rotation(orientation)
    moment = np.cross(np.array(at) - position, force)
    felt = np.concatenate([turn.T @ force, turn.T @ moment])

    reflect = np.diag([-1.0 if a == mirror.axis else 1.0 for a in "xyz"])
    there = calibration.output_spec(spec)
    there_turn = rotation(there.orientations[0])
    assert np.linalg.det(there_turn) == pytest.approx(1), "a right-handed frame again"
    there_moment = np.cross(reflect @ at - there.positions[0], reflect @ force)
    expected = np.concatenate([there_turn.T @ reflect @ force, there_turn.T @ there_moment])

    made = calibration.apply(chunk_of(felt[None, None])).values[0, 0]
    np.testing.assert_allclose(made, expected, atol=2e-4)


@given(mirrors, points, quaternions)
def test_the_mirror_image_of_the_mirror_image_is_the_array(mirror, position, orientation):
    spec = posed(position, orientation)
    once = replace(Calibration.of("d", spec), mirror=mirror)
    image = once.output_spec(spec)
    again = replace(Calibration.of("d", image), mirror=mirror).output_spec(image)
    assert again.positions == spec.positions
    same = np.allclose(again.orientations, spec.orientations)
    assert same or np.allclose(again.orientations, -np.array(spec.orientations))
    values = np.random.default_rng(0).normal(size=(3, 1, 6))
    chunk = chunk_of(values)
    assert np.array_equal(once.apply(once.apply(chunk)).values, chunk.values)


def test_a_simulated_left_array_becomes_the_right_one() -> None:
    pytest.importorskip("mujoco")
    pytest.importorskip("trimesh")
    from tactile_rt.sim_backend.arrays.files import load_array
    from tactile_rt.sim_backend.world import array_spec

    arrays = [load_array(f"mouse-{side}") for side in ("left", "right")]
    left, right = (array_spec(array.whiskers, "mouse") for array in arrays)
    assert left.differences(right)
    mirrored = replace(Calibration.of("d", left), mirror=Mirror()).output_spec(left)
    assert mirrored.differences(right) == []


@pytest.mark.parametrize(
    ("channel", "unit", "sign"),
    [
        ("fz", "N", -1), ("fx", "N", 1), ("z", "m", -1), ("acc_z", "m/s^2", -1),
        ("mz", "N m", 1), ("bx", "T", -1), ("bz1", "T", 1), ("gyro.y", "rad/s", -1),
        ("temperature", "K", 1), ("index", "Pa", 1), ("vx", "V", 1),
    ],
)  # fmt: skip
def test_vectors_and_pseudovectors_are_told_by_name_and_unit(channel, unit, sign):
    assert Mirror().sign(channel, unit) == sign


@pytest.mark.parametrize(("channel", "unit"), [("theta", "rad"), ("x", "1"), ("grip", "N")])
def test_what_name_and_unit_do_not_tell_must_be_said(channel: str, unit: str) -> None:
    with pytest.raises(ConfigError, match=f"mirror.signs.{channel} to 1 or -1"):
        Mirror().sign(channel, unit)
    spec = replace(small_spec(), channels=("fy", channel), units=("N", unit))
    with pytest.raises(ConfigError, match=channel):
        replace(Calibration.of("d", spec), mirror=Mirror())
    told = replace(Calibration.of("d", spec), mirror=Mirror(signs={channel: -1}))
    assert told.signs == (1, -1)


# ---- a source


class Silent(ArraySource):
    """A source that gives nothing in time."""

    def read(self, timeout: float | None = None) -> Chunk | None:
        return None


class Talkative(ArraySource):
    """A source with more to it than the base class has."""

    health = "streaming"

    def set_whisking(self, frequency: float) -> str:
        return f"whisking at {frequency} Hz"


def test_a_calibrated_source_is_the_source_but_for_its_samples() -> None:
    spec = small_spec()
    raw = Talkative(spec, cut_chunks(np.ones((20, *spec.shape)), spec.rate_hz), live=True)
    calibration = replace(Calibration.of("d", spec), gain=(2.0, 3.0), mapping={"C1": "A1"})
    with CalibratedSource(raw, calibration) as source:
        assert source.live
        assert source.spec.elements == ("C1",)
        assert source.health == "streaming"
        assert source.set_whisking(8.0) == "whisking at 8.0 Hz"
        first = source.read(0)
        assert first is not None
        assert first.values.tolist() == [[[2.0, 3.0]]] * 9
        assert source.stats is raw.stats
        assert source.stats == SourceStats(delivered=9)
        raw.stats = SourceStats(missing=1)  # a source may begin to count anew
        assert source.stats.missing == 1
        assert not hasattr(source, "battery")
        raw.health = "lost"
        assert source.health == "lost"
        assert source.calibration is calibration
        assert repr(source)
    with pytest.raises(EndOfStream):
        source.read(0)
    with pytest.raises(EndOfStream):
        raw.read(0)


def test_a_calibrated_source_passes_on_silence_and_may_be_copied() -> None:
    source = CalibratedSource(Silent(small_spec(), []), Calibration.of("d", small_spec()))
    assert source.read(0) is None
    assert copy.copy(source).spec == source.spec
    simple = CalibratedSource(ArraySource(small_spec(), []), source.calibration)
    assert pickle.loads(pickle.dumps(simple)).spec == source.spec
    assert not simple.live, "what waits for its reader still does"


# ---- impossible calibrations


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"device": "../../etc/passwd"}, "device id '../../etc/passwd'"),
        ({"units": ("N",)}, "raw.units has 1 values for 2 raw channels"),
        ({"elements": ("A0", "A0", "A2")}, "raw.elements"),
        ({"output_channels": ("a", "a")}, "output.channels"),
        ({"output_channels": AXES}, "output.units has 2 values for 6 output channels"),
        ({"gain": (1.0,)}, "gain has 1 values for 2 raw channels"),
        ({"gain": (1.0, 1.0), "output_channels": AXES, "output_units": LOADS}, "give every elem"),
        ({"tare": {"A0": (1.0,)}}, "tare.A0 has 1 values for 2 raw channels"),
        ({"tare": {"a0": (1.0, 1.0)}}, "tare.a0: no raw element 'a0'; did you mean A0"),
        ({"tare": {"A0": (1.0, np.inf)}}, "tare.A0 must be finite"),
        ({"matrices": {"A1": ((1.0, 0.0),)}}, "matrix.A1 has 1 rows for 2 output channels"),
        ({"matrices": {"A1": ((1.0, 0.0), (1.0,))}}, "matrix.A1, row mz has 1 values for 2 raw"),
        ({"mapping": {"C2": "A1", "C1": "A1"}}, "mapping: one raw element is mapped twice"),
        ({"mirror": Mirror(signs={"my": 1})}, "mirror.signs.my: no output channel 'my'"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, object], what: str) -> None:
    assert what in refusal(replace, Calibration.of("d", small_spec()), **changes)


@pytest.mark.parametrize("fields", [{"axis": "u"}, {"element_axis": ""}, {"signs": {"fx": 0}}])
def test_a_mirror_that_cannot_be_is_refused(fields: dict[str, object]) -> None:
    assert "mirror" in refusal(Mirror, **fields)


# ---- files


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config" / "tactile_rt" / "calibration"


def test_what_is_written_is_read(home) -> None:
    calibration = whole_calibration(np.random.default_rng(7))
    path = save_calibration(calibration)
    assert path == home / "bench-7.toml" == calibration_path("bench-7")
    assert load_calibration("bench-7") == calibration
    assert load_calibration(path) == load_calibration(str(path)) == calibration
    assert [p.name for p in home.iterdir()] == ["bench-7.toml"], "no temporary file is left"
    plain = Calibration.of("plain", small_spec())
    save_calibration(plain)
    assert load_calibration("plain") == plain


any_float = st.floats(allow_nan=False, allow_infinity=False)
any_name = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8)


@given(st.data())
def test_any_names_and_numbers_survive_a_file(tmp_path_factory, data) -> None:
    elements = tuple(data.draw(st.lists(any_name, min_size=1, max_size=3, unique=True)))
    channels = tuple(data.draw(st.lists(any_name, min_size=1, max_size=3, unique=True)))
    row = st.tuples(*[any_float] * len(channels))
    calibration = Calibration(
        "d",
        elements,
        channels,
        tuple(data.draw(st.tuples(*[any_name] * len(channels)))),
        tare={elements[0]: data.draw(row)},
        gain=data.draw(row),
        matrices={elements[-1]: tuple(data.draw(row) for _ in channels)},
        mapping=dict.fromkeys(data.draw(st.lists(any_name, max_size=1)), elements[0]),
        history=tuple(data.draw(st.lists(any_name, max_size=2))),
    )
    path = tmp_path_factory.mktemp("calibration") / "d.toml"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration


def test_without_a_configured_folder_it_is_the_home_s(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for unset in ("", "relative/folder"):
        monkeypatch.setenv("XDG_CONFIG_HOME", unset)
        expected = tmp_path / ".config/tactile_rt/calibration/d.toml"
        assert calibration_path("d") == expected


def test_a_user_without_a_home_is_told_so(monkeypatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    for use in (calibration_path, load_calibration):
        assert "no home to keep calibrations in: set XDG_CONFIG" in refusal(use, "d")


def test_a_folder_that_is_not_there_is_not_made(tmp_path) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        save_calibration(Calibration.of("d", small_spec()), tmp_path / "typo" / "d.toml")
    assert list(tmp_path.iterdir()) == []


GOOD = """
version = 1
device = "d"
[raw]
elements = ["A0", "A1"]
channels = ["fy", "mz"]
units = ["N", "N m"]
[tare]
A0 = [1, 2.5]
[matrix]
A1 = [[1.0, 0.0], [0.1, 1.0]]
"""


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("version = 1", "version = 2", "is a calibration of version 2; this release reads 1"),
        ("version = 1", "version = ", ":2: not TOML: Invalid value"),
        ("[tare]", "[tarre]", "the file has no key 'tarre'; did you mean tare?"),
        ('device = "d"', "", "needs a key 'device'"),
        ('device = "d"', "device = 7", "device: expected text, got 7"),
        ("[1, 2.5]", "[1, 2.5, 3]", "tare.A0 has 3 values for 2 raw channels"),
        ("[1, 2.5]", '[1, "2,5"]', "tare.A0[1]: expected a number, got '2,5'"),
        ("[tare]", '[mirror]\naxis = "w"\n[tare]', "mirror.axis must be x, y or z, not 'w'"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(tmp_path, old: str, new: str, what: str) -> None:
    path = tmp_path / "d.toml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    said = refusal(load_calibration, path)
    assert said.startswith(f"{path}:") and what in said


def test_the_device_meant_is_named(home) -> None:
    assert "there are none" in refusal(load_calibration, "left-hand")
    save_calibration(Calibration.of("left-hand", small_spec()))
    assert "did you mean left-hand?" in refusal(load_calibration, "left_hand")


# ---- tare


def quiet(rng: np.random.Generator, n: int = 2000, elements: int = 4) -> np.ndarray:
    """(n, element, 6) normal noise of standard deviation 5 about 8 million counts."""
    return 8e6 + 1000 * np.arange(6) + 5 * rng.normal(size=(n, elements, 6))


def source_of(values: np.ndarray, valid: np.ndarray | None = None) -> ArraySource:
    spec = gauge_spec(values.shape[1])
    if valid is not None:
        return ArraySource(spec, [chunk_of(values, valid)])
    return ArraySource(spec, cut_chunks(values, spec.rate_hz))


def test_a_tare_is_the_median_and_its_noise_the_standard_deviation() -> None:
    values = quiet(np.random.default_rng(9))
    values[::50] += 1e5  # spikes, one sample in fifty
    measured = tare(source_of(values), 5.0)
    expected = 8e6 + 1000 * np.arange(6)
    np.testing.assert_allclose(measured.offset - expected, 0, atol=0.8)  # float32 counts by 0.5
    np.testing.assert_allclose(measured.noise, 5, rtol=0.12)
    assert 0.9 < measured.changes < 1
    assert measured.samples.tolist() == [2000] * 4
    assert measured.seconds == pytest.approx(1.999)
    assert measured.untared == ()


def test_it_reads_only_the_seconds_asked_for_and_below_a_calibration() -> None:
    source = source_of(quiet(np.random.default_rng(10), 4000))
    calibration = replace(Calibration.of("d", source.spec), gain=(0.0,) * 6)
    measured = tare(CalibratedSource(source, calibration), 1.0)
    assert measured.seconds == pytest.approx(1.0, abs=0.01)
    assert (measured.offset > 7e6).all()
    assert source.stats.delivered < 1020


@pytest.mark.parametrize("seed", range(16))
def test_noise_alone_is_never_taken_for_a_touch(seed: int) -> None:
    """35 x 6 channels: white, slow (filtered over 20 samples) and quantised noise."""
    rng = np.random.default_rng(seed)
    n, shape = (160, 2000)[seed % 2], (35, 6)
    white = rng.normal(size=(n + 19, *shape))
    slow = np.cumsum(white, axis=0)
    slow = (slow[20:] - slow[:-20]) / np.sqrt(20) if n == 2000 else white[19:]
    for values in (white[:n], slow, np.round(0.3 * white[:n])):
        assert tare(source_of(values), 5.0).untared == ()


def pushed(rng: np.random.Generator, kind: str) -> np.ndarray:
    values, t = quiet(rng), np.linspace(0, 1, 2000)
    values[:, 2, 4] += {
        "tap": 100.0 * ((t > 0.4) & (t < 0.404)),
        "touch": 40.0 * ((t > 0.3) & (t < 0.8)),
        "let go": 40.0 * (t < 0.2),
        "press": 40.0 * (t > 0.52),
        "drift": -60.0 * t,
        "slow drift": 25.0 * t,
    }[kind]
    return values


@pytest.mark.parametrize(
    ("kind", "said"),
    [(kind, "is being touched: s4 moved by") for kind in ("tap", "touch", "let go", "press")]
    + [(kind, "drifts: s4 went by") for kind in ("drift", "slow drift")],
)
def test_a_touched_or_drifting_array_is_refused(kind: str, said: str) -> None:
    source = source_of(pushed(np.random.default_rng(11), kind))
    assert f"gauges: element A2 {said}" in refusal(tare, source, 5.0)


def test_a_dead_element_is_left_out() -> None:
    values = quiet(np.random.default_rng(14))
    valid = np.ones(values.shape[:2], dtype=np.bool_)
    valid[:, 1], valid[:1990, 3] = False, False
    values[~valid] = np.nan
    measured = tare(source_of(values, valid), 5.0)
    assert measured.untared == ("A1", "A3")
    assert measured.samples.tolist() == [2000, 0, 2000, 10]
    assert (measured.offset[[1, 3]] == 0).all()
    assert np.isfinite(measured.noise).all()


def test_too_few_samples_say_how_long_it_takes() -> None:
    with pytest.raises(ConfigError, match=r"63 valid samples in 0\.062 s, and a tare needs 64: t"):
        tare(source_of(quiet(np.random.default_rng(15), 63)), 2.0)


def test_a_silent_source_is_not_waited_for(monkeypatch) -> None:
    monkeypatch.setattr("tactile_rt.calibration.tare_measurement.PATIENCE_S", 0.0)
    for source in (Silent(small_spec(), []), ArraySource(small_spec(), [])):
        with pytest.raises(SourceError, match="no sample came"):
            tare(source, 0.01)


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf])
def test_impossible_seconds_are_refused(seconds: float) -> None:
    assert "seconds" in refusal(tare, source_of(quiet(np.random.default_rng(16))), seconds)


# ---- fitting


def bench(rng: np.random.Generator, n: int = 60, noise: float = 0.0):
    """A made-up cell: raw = C load + c. Returns raw, loads, the true matrix and offset."""
    scale = np.array([1, 1, 1, 0.01, 0.01, 0.01])
    loads = rng.uniform(-1, 1, size=(n, 6)) * scale
    cross = (np.eye(6) + 0.15 * rng.normal(size=(6, 6))) * (1e5 / scale)
    offset = rng.normal(size=6) * 1e6
    raw = loads @ cross.T + offset + noise * rng.normal(size=(n, 6))
    return raw, loads, np.linalg.inv(cross), offset


def test_without_noise_the_matrix_and_offset_come_back() -> None:
    raw, loads, matrix, offset = bench(np.random.default_rng(17))
    fit = calibrate(raw, loads)
    np.testing.assert_allclose(fit.matrix, matrix, rtol=1e-7, atol=1e-9 * np.abs(matrix).max())
    np.testing.assert_allclose(fit.tare, offset, rtol=0, atol=1e-3)
    assert (fit.rms < 1e-9).all()
    assert fit.warnings == ()
    np.testing.assert_allclose(fit.r_squared, 1)


def test_with_noise_it_is_numpy_s_least_squares() -> None:
    raw, loads, matrix, _ = bench(np.random.default_rng(18), noise=300.0)
    fit = calibrate(raw, loads)
    # the textbook's design: a column of ones, no scaling; solved by QR, not by the SVD of lstsq
    design = np.column_stack([raw, np.ones(len(raw))])
    q, r = np.linalg.qr(design)
    solution = np.linalg.solve(r, q.T @ loads)
    np.testing.assert_allclose(fit.matrix, solution[:6].T, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(fit.matrix @ fit.tare, -solution[6], rtol=1e-6)
    left = loads - design @ solution
    np.testing.assert_allclose(fit.residuals, left, atol=1e-9)
    np.testing.assert_allclose(fit.rms, np.sqrt((left**2).mean(axis=0)), rtol=1e-6)
    np.testing.assert_allclose(fit.matrix, matrix, atol=0.05 * np.abs(matrix).max())
    # residuals of a least-squares fit are at right angles to what it was fitted from
    np.testing.assert_allclose((raw - raw.mean(axis=0)).T @ fit.residuals / 1e5, 0, atol=1e-6)
    new_raw, new_loads, _, _ = bench(np.random.default_rng(18))
    predicted = (new_raw - fit.tare) @ fit.matrix.T
    assert (np.sqrt(((predicted - new_loads) ** 2).mean(axis=0)) < 3 * fit.rms).all()


def test_a_slip_of_the_pen_is_the_worst_point() -> None:
    raw, loads, _, _ = bench(np.random.default_rng(21), n=100, noise=30.0)
    loads[37, 5] *= -3
    fit = calibrate(raw, loads)
    assert fit.worst[0] == 37
    assert len(fit.worst) == 5


def test_an_axis_never_loaded_is_named() -> None:
    raw, loads, _, _ = bench(np.random.default_rng(22), noise=10.0)
    loads[:, 4] = 0.0
    fit = calibrate(raw, loads)
    assert any(w.startswith("my is never loaded") for w in fit.warnings)
    assert (fit.matrix[4] == 0).all()
    assert fit.load_condition == np.inf


def test_a_weight_always_at_the_same_lever_is_named() -> None:
    """fy and mz in proportion: a perfect fit, and a matrix that is wrong everywhere else."""
    rng = np.random.default_rng(23)
    _, loads, matrix, offset = bench(rng)
    loads[:, 5] = 0.02 * loads[:, 1]
    raw = loads @ np.linalg.inv(matrix).T + offset + rng.normal(size=loads.shape)
    fit = calibrate(raw, loads)
    assert (fit.rms < 1e-3).all()
    assert any("fy and mz were always loaded together" in w for w in fit.warnings)
    assert any("readings are nearly dependent" in w for w in fit.warnings)
    assert fit.load_condition > 1e6


@pytest.mark.parametrize(
    ("loads_made", "channels", "said"),
    [(8, 6, "8 loads are few"), (60, 2, "6 axes cannot be separated")],
)
def test_a_fit_of_too_little_is_doubted(loads_made: int, channels: int, said: str) -> None:
    raw, loads, _, _ = bench(np.random.default_rng(24), n=loads_made)
    assert any(said in w for w in calibrate(raw[:, :channels], loads).warnings)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda raw, loads: (raw[:6], loads[:6]), "6 loads for 6 channels and an offset: at le"),
        (lambda raw, loads: (raw[:9], loads), r"\(9, 6\) and loads \(60, 6\)"),
        (lambda raw, loads: (raw, loads[:, :5]), "disagree"),
        (lambda raw, loads: (raw, loads * np.nan), "finite"),
        (lambda raw, loads: (raw * [1, 1, 0, 1, 1, 1], loads), "channel s2 never changes: is it"),
        (lambda raw, loads: (raw, loads * 0 + 0.1), "all loads are the same"),
    ],
)
def test_tables_that_cannot_be_fitted_are_refused(change, what: str) -> None:
    raw, loads, _, _ = bench(np.random.default_rng(26))
    with pytest.raises(ConfigError, match=what):
        calibrate(*change(raw, loads), channels=GAUGES)


# ---- tables


def test_a_table_of_readings(tmp_path) -> None:
    path = tmp_path / "loads.csv"
    text = "\ufeff# the lab, 21 November\nraw_b, mz ,raw_a,fy\n\n1,0.5,2,-1e-3\n,,,\n3,4,5,6\n"
    path.write_text(text, encoding="utf-8")
    table = read_loads(path)
    assert (table.axes, table.units) == (("fy", "mz"), ("N", "N m"))
    assert table.loads.tolist() == [[-1e-3, 0.5], [6, 4]]
    assert table.channels == ("b", "a")
    assert table.raw.tolist() == [[1, 2], [3, 5]]
    assert table.lines == (4, 6)
    assert len(table.times) == 0


def test_a_table_of_times_takes_medians_of_valid_samples(tmp_path) -> None:
    path = tmp_path / "loads.csv"
    path.write_text("start_s,end_s,fy\n0,0.1,0\n0.1,0.2,1\n")
    table = read_loads(path)
    values = np.zeros((250, 2, 2))
    values[:100, 1], values[100:, 1] = (1, 2), (3, 4)
    values[150:155] = 1e6  # a spike
    valid = np.ones((250, 2), dtype=np.bool_)
    valid[100:130] = False
    values[100:130] = np.nan
    (whole,) = cut_chunks(values, 1000.0, samples=250, start_ns=10**15)
    recorded = replace(whole, valid=valid)
    assert median_readings(table, recorded, small_spec(2), "A1").tolist() == [[1, 2], [3, 4]]
    with pytest.raises(ConfigError, match="no element 'B1'; there are A0, A1"):
        median_readings(table, recorded, small_spec(2), "B1")
    valid[100:200] = False
    with pytest.raises(ConfigError, match=r"line 3: no valid sample of A0 from 0.1 to 0.2 s; the"):
        median_readings(table, recorded, small_spec(2), "A0")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is empty; its first line names the columns"),
        ("raw_a,fy\n", "needs a line of column names"),
        ("raw_a,weight\n1,2\n", "no column 'weight'; there are fx, fy"),
        ("raw_a\n1\n", "no load; add columns of fx"),
        ("fy\n1\n", "needs readings (raw_CHANNEL) or times"),
        ("raw_a,start_s,end_s,fy\n1,2,3,4\n", "one of the two"),
        ("start_s,fy\n1,2\n", "start_s and end_s go together"),
        ("start_s,end_s,fy\n2,1,2\n", "loads.csv:2: start_s must be 0 or more and before end_s"),
        ("raw_a,fy\n1,2 N\n", "loads.csv:2: fy: expected a number, got '2 N'"),
    ],
)
def test_a_bad_table_is_one_line_that_names_it(tmp_path, text: str, what: str) -> None:
    path = tmp_path / "loads.csv"
    path.write_text(text)
    said = refusal(read_loads, path)
    assert said.startswith(str(path)) and what in said


# ---- the page about it


def test_the_documented_file_is_one(tmp_path) -> None:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "calibration.md"
    (example,) = re.findall(r"```toml[^\n]*\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    path = tmp_path / "left-pad.toml"
    path.write_text(example)
    calibration = load_calibration(path)
    made = calibration.apply(chunk_of(np.array([[[9123.0, -411, 952], [77, -2021, 640]]])))
    # by hand: C2 is A1 by its matrix, C1 is A0 by its gain; fx, fy and mz stay in the mirror
    expected = [[0.034, 0.22, 1.1e-4], [0.1, 0, 0]]
    np.testing.assert_allclose(made.values[0], expected, rtol=1e-4, atol=1e-7)
