"""A device that is not as its file says, recovered from a recording of it."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.core.errors import SpecMismatch
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.measuring.fitting import Fitted, fit_array, read_described
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.transducer import device_spec
from tests.helpers.plucked import plucked
from tests.helpers.refusals import refusal
from tests.helpers.source_tree import ROOT

ROBOT = ROOT / "docs" / "arrays" / "robot.toml"
MAGNETS = ROOT / "docs" / "arrays" / "magnets.toml"
SENSOR = """[sensor]
rate_hz = 500
[[sensor.channel]]
name = "my"
unit = "N m"
range = 1e-4
resolution = 2e-9        # 12 bits over twice the range
noise_density = 4e-10    # N m per root of a hertz

[[sensor.channel]]
name = "bridge"
unit = "V"
of = { mz = 1e4, fy = 3.0 }
range = 1
noise_density = 4e-6
drift = 2e-4

[defaults]"""
# What the device has other than its file says.
TRUTH = {
    "young_modulus_pa = 2.9e9": "young_modulus_pa = 4.5e9",
    "damping_ratio = 0.05": "damping_ratio = 0.02",
    "noise_density = 4e-10": "noise_density = 8e-10",
    "resolution = 2e-9": "resolution = 3e-9",
    'unit = "V"': 'unit = "V"\noffset = 1e-3',
    "drift = 2e-4": "drift = 5e-4",
    "arc_length_mm = 15\nbase_y_mm = 6\nbase_z_mm = 3": (
        "arc_length_mm = 15\nyoung_modulus_pa = 9e9\nbase_y_mm = 6\nbase_z_mm = 3"
    ),
}
PLUCKED = ("A0", "A1", "A3", "B2")


def otherwise(text: str, changes: dict[str, str]) -> str:
    for was, becomes in changes.items():
        assert was in text, was
        text = text.replace(was, becomes, 1)
    return text


@pytest.fixture(scope="module")
def described(tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("described") / "robot.toml"
    path.write_text(ROBOT.read_text().replace("[defaults]", SENSOR, 1))
    return path


@pytest.fixture(scope="module")
def device(described: Path) -> Path:
    """The file that the device would have."""
    path = described.with_name("device.toml")
    path.write_text(otherwise(described.read_text(), TRUTH))
    return path


@pytest.fixture(scope="module")
def recorded(device: Path):
    return plucked(device, PLUCKED)


@pytest.fixture(scope="module")
def fitted(described: Path, recorded) -> Fitted:
    return fit_array(described, *recorded)


def found(fitted: Fitted) -> dict[str, tuple[float, float]]:
    return {f.what: (f.measured.low, f.measured.high) for f in fitted.findings if f.measured}


@pytest.mark.parametrize(
    ("what", "truth"),
    [
        ("rate", 500),
        ("noise density of my", 8e-10),
        ("noise density of bridge", 4e-6),
        ("resolution of my", 3e-9),
        ("resolution of bridge", 0),
        ("drift of bridge", 5e-4),
        ("offset of bridge", 1e-3),
        ("young_modulus_pa", 4.5e9),
        ("young_modulus_pa of A3", 9e9),
        ("damping_ratio", 0.02),
    ],
)
def test_the_truth_lies_in_the_interval(fitted: Fitted, what: str, truth: float) -> None:
    low, high = found(fitted)[what]
    assert low <= truth <= high
    assert high <= 3 * low or "offset" in what


def test_every_plucked_whisker_has_its_resonance(fitted: Fitted) -> None:
    told = {f.what: f for f in fitted.findings}
    for name in PLUCKED:
        f = told[f"resonance of {name}"]
        stiffer = 9 / 2.9 if name == "A3" else 4.5 / 2.9
        assert f.measured is not None
        assert f.described is not None
        assert f.measured.value / f.described == pytest.approx(stiffer**0.5, rel=5e-3)
    assert "A2, B0, B1, B3" in told["resonance"].note


def test_the_file_is_the_same_but_for_the_numbers(described: Path, fitted: Fitted) -> None:
    before, after = described.read_text(), fitted.text
    assert tomllib.loads(after)["whisker"][3]["young_modulus_pa"] == pytest.approx(9e9, rel=0.02)
    kept = [line for line in after.splitlines() if "measured: " not in line]
    assert kept == [line for line in before.splitlines() if line in kept]
    comments = [line.partition("#")[2] for line in before.splitlines() if "#" in line]
    assert all(comment in after for comment in comments)
    (density,) = (line for line in after.splitlines() if "N m per root of a hertz" in line)
    assert re.fullmatch(
        r"noise_density = [\d.e-]+ +# N m per root of a hertz; measured: [\d.e-]+ \+- [\d.]+ %",
        density,
    )


def test_a_fitted_file_fits(tmp_path: Path, recorded, fitted: Fitted) -> None:
    """Measured again, it is left as it is, and what a comment says stands in it once."""
    path = tmp_path / "fitted.toml"
    path.write_text(fitted.text)
    again = fit_array(path, *recorded)
    assert again.text == fitted.text
    assert not any(f.edits for f in again.findings)


def test_simulated_from_its_file_it_is_as_noisy_as_the_device(
    tmp_path: Path, recorded, fitted: Fitted
) -> None:
    path = tmp_path / "fitted.toml"
    path.write_text(fitted.text)
    (array,) = load_animals(str(path))
    _, real = recorded
    assert array.sensor is not None
    still = replace(real, values=np.zeros_like(real.values))
    made = Sensor(SensorModel(), device_spec((array,)), 5, array.sensor).push(still)
    assert made is not None
    rest = slice(0, 30_000)  # before the first pluck; differences tell nothing of drift
    theirs, ours = (np.diff(c.values[rest], axis=0).std(axis=(0, 1)) for c in (real, made))
    np.testing.assert_allclose(ours, theirs, rtol=0.02)


@pytest.fixture(scope="module")
def magnets(tmp_path_factory) -> tuple[Path, Path]:
    """Magnets read at 400 Hz: described, and as they are."""
    path: Path = tmp_path_factory.mktemp("magnets") / "magnets.toml"
    faster = {"rate_hz = 80": "rate_hz = 400", "bandwidth_hz = 35": "bandwidth_hz = 150"}
    path.write_text(otherwise(MAGNETS.read_text(), faster))
    truth = {
        "mount_stiffness_nm_rad = 2e-4": "mount_stiffness_nm_rad = 3e-4",
        "mount_damping_nms_rad = 2e-7": "mount_damping_nms_rad = 6e-8",
    }
    device = path.with_name("device.toml")
    device.write_text(otherwise(path.read_text(), truth))
    return path, device


def test_where_the_mount_gives_more_it_is_the_mount_that_is_fitted(magnets) -> None:
    described, device = magnets
    fitted = fit_array(described, *plucked(device, ("A0", "B1"), rest_s=20, angle=0.3))
    intervals = found(fitted)
    for what, truth in (("mount_stiffness_nm_rad", 3e-4), ("mount_damping_nms_rad", 6e-8)):
        low, high = intervals[what]
        assert low <= truth <= high
        assert high < 1.25 * low
    notes = {f.what: f.note for f in fitted.findings}
    assert re.fullmatch(r"rest spans \d+ s, and a drift takes 60 s", notes["drift of by"])
    assert "young_modulus_pa" not in intervals


@pytest.mark.parametrize(
    ("rate_hz", "ratio", "said"),
    [
        (80, 0.02, r"resonance of A0: .*for 80 samples a second: what swings at 33\.\d Hz may be"),
        (60, 0.3, r"resonance: .*for 60 samples a second: A0, A1, A2, A3, B0, B1 and 2 more"),
    ],
)
def test_what_is_too_fast_for_the_rate_is_said_and_left(
    described: Path, tmp_path: Path, rate_hz: int, ratio: float, said: str
) -> None:
    path = tmp_path / "slow.toml"
    slower = {"rate_hz = 500": f"rate_hz = {rate_hz}", "ratio = 0.05": f"ratio = {ratio}"}
    path.write_text(otherwise(described.read_text(), slower))
    fitted = fit_array(path, *plucked(path, ("A0",), rest_s=20))
    assert "young_modulus_pa" not in found(fitted)
    assert any(re.match(said, f"{f.what}: {f.note}") for f in fitted.findings)
    assert "young_modulus_pa = 2.9e9\n" in fitted.text


def test_noise_below_half_a_step_is_said_and_left(tmp_path: Path) -> None:
    path = tmp_path / "coarse.toml"
    coarse = {"resolution = 2e-9": "resolution = 5e-8"}
    path.write_text(otherwise(ROBOT.read_text().replace("[defaults]", SENSOR, 1), coarse))
    fitted = fit_array(path, *plucked(path, rest_s=20))
    told = {f.what: f for f in fitted.findings}
    noise = told["noise density of my"]
    assert str(noise.measured) == "at most 1.6e-09"  # half of 5e-8 over the root of 250 Hz
    assert "rounding hides it" in noise.note
    assert noise.edits == ()
    assert told["resolution of my"].measured.value == pytest.approx(5e-8, rel=1e-3)


def test_whiskers_that_deviate_are_named(described: Path) -> None:
    spec, chunk = plucked(described, rest_s=20)
    values = chunk.values.copy()
    rng = np.random.default_rng(0)
    values[:, 2, 1] += rng.normal(0, 3e-4, len(values))
    values[:, 5, 1] = 0.125
    fitted = fit_array(described, spec, replace(chunk, values=values))
    (note,) = (f.note for f in fitted.findings if f.what == "noise density of bridge")
    assert note == "unlike most: A2; always read the same: B1"


def test_readings_beyond_the_range_are_in_another_unit(described: Path) -> None:
    spec, chunk = plucked(described, ("A0",), rest_s=20)
    told = {f.what: f for f in fit_array(described, spec, chunk).findings}
    assert not any(what.startswith("range") for what in told)
    values = chunk.values * np.array([1, 1000], np.float32)
    values[7] = np.nan
    told = {f.what: f for f in fit_array(described, spec, replace(chunk, values=values)).findings}
    assert "range of my" not in told
    assert told["range of bridge"].note.endswith("is the recording in V, and is that the range?")


def test_both_sides_of_a_mirrored_file_are_one_description(described: Path, tmp_path: Path) -> None:
    path, device = tmp_path / "both.toml", tmp_path / "device.toml"
    path.write_text(described.read_text().replace("name = ", "mirror = true\nname = ", 1))
    own = "arc_length_mm = 21\nyoung_modulus_pa = 2.9e9"
    path.write_text(path.read_text().replace("arc_length_mm = 21", own, 1))
    device.write_text(path.read_text().replace(own, own.replace("2.9e9", "4e9"), 1))
    fitted = fit_array(path, *plucked(device, ("L.A1", "R.A1"), rest_s=20))
    low, high = found(fitted)["young_modulus_pa of R.A1, L.A1"]
    assert low <= 4e9 <= high
    assert tomllib.loads(fitted.text)["whisker"][1]["young_modulus_pa"] == pytest.approx(4e9, 0.02)


def test_what_is_not_of_the_file_is_refused(described: Path, recorded, tmp_path: Path) -> None:
    spec, _ = recorded
    assert "is a .toml file" in refusal(read_described, Path("whiskers.csv"), spec)
    placed = tmp_path / "placed.toml"
    placed.write_text(f'[[animal]]\narray = "{described}"\n')
    assert "name the array's own file" in refusal(read_described, placed, spec)
    said = refusal(read_described, ROBOT, spec)
    assert "has no [sensor]: add rate_hz and a [[sensor.channel]] for each of my (N m), " in said
    with pytest.raises(SpecMismatch, match=r"not of .*robot.toml: channels\[1\] is 'mz', not"):
        read_described(described, replace(spec, channels=("my", "mz")))
    with pytest.raises(SpecMismatch, match="has no whisker Z9"):
        read_described(described, replace(spec, elements=("Z9", *spec.elements[1:])))
    with pytest.raises(SpecMismatch, match="not of"):
        read_described(MAGNETS, spec)


def test_what_holds_too_little_is_refused(described: Path, recorded) -> None:
    spec, chunk = recorded
    assert "has 50 samples" in refusal(fit_array, described, spec, chunk.select(slice(50)))
    assert "at rest for 3 s" in refusal(fit_array, described, spec, chunk.select(slice(1000)))
    some = np.random.default_rng(0).random(len(chunk)) < 0.8
    said = refusal(fit_array, described, spec, chunk.select(some))
    assert re.search(r"lacks \d+ of \d+ samples", said)
    still = replace(chunk, t_ns=np.zeros_like(chunk.t_ns))
    assert "do not advance" in refusal(fit_array, described, spec, still)


def test_a_few_lost_samples_change_nothing_much(described: Path, recorded, fitted: Fitted) -> None:
    spec, chunk = recorded
    some = np.random.default_rng(0).random(len(chunk)) < 0.98
    some[[0, -1]] = True
    again = fit_array(described, spec, chunk.select(some))
    before = {f.what: f.measured.value for f in fitted.findings if f.measured}
    for f in again.findings:
        if f.what in ("rate", "noise density of my", "damping_ratio", "young_modulus_pa"):
            assert f.measured.value == pytest.approx(before[f.what], rel=0.04)
