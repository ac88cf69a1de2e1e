"""Robots' arrays by name: as their codecs say, in range when touched, the same over the wire."""

import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import pytest

from tactile_rt.calibration import declare_calibration
from tactile_rt.core.stream import ArraySpec, Chunk, concatenate
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.drivers.codec import Codec
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sim_backend.arrays.files import (
    ROBOTS,
    load_animals,
    load_array,
    read_animals,
    robot_text,
)
from tactile_rt.sim_backend.sweep import Sweep, usual_size
from tactile_rt.sim_backend.transducer import device_spec, sensor_of
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeSerial
from tests.helpers.codec_contract import chunk_of, decode, join, stacked
from tests.helpers.source_tree import ROOT
from tests.helpers.waiting import until

DATA = ROOT / "tactile_rt" / "sim_backend" / "arrays" / "data"
NAMES = sorted(ROBOTS)
CLEAR = 20.0  # least reading of a touch, in standard deviations of a sample's noise
AT_REST = 20  # samples


def codec_of(name: str) -> Codec:
    options = dict(parse_qsl(ROBOTS[name]))
    return make_codec("serial", options.pop("codec"), options)


def spec_of(name: str) -> ArraySpec:
    return device_spec(load_animals(name))


def sensor(name: str) -> SensorSpec:
    described = sensor_of(load_animals(name))
    assert described is not None
    return described


@pytest.fixture(scope="module")
def sweep() -> Callable[[str], Chunk]:
    """One mug going by an array of this name, each simulated once."""
    made: dict[str, Chunk] = {}

    def of(name: str) -> Chunk:
        if name not in made:
            url = f"sim:{name}?objects=mug&sweeps=1&pace=fast&seed=3&height_mm=-2&gap_mm=1"
            with open_source(url) as source:
                assert source.spec == spec_of(name)
                made[name] = concatenate(list(source))
        return made[name]

    return of


def test_every_file_has_a_name_and_every_name_a_file() -> None:
    assert sorted(file.stem for file in DATA.glob("*.toml")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_the_array_of_its_file(name: str) -> None:
    array = load_array(name)
    assert array.name == name
    assert (array,) == read_animals(DATA / f"{name}.toml")
    text = robot_text(name)
    assert "github.com/" in text and "Estimated" in text, "a source, and what it does not say"
    assert f"serial:///dev/ttyACM0?{ROBOTS[name]}" in text


@pytest.mark.parametrize("name", NAMES)
def test_its_codec_carries_it(name: str) -> None:
    array, carried = spec_of(name), codec_of(name).spec
    assert carried is not None
    assert (array.elements, array.channels) == (carried.elements, carried.channels)
    assert (array.units, array.rate_hz) == (carried.units, carried.rate_hz)
    assert declare_calibration(carried, array).array == array


@pytest.mark.parametrize("name", NAMES)
def test_its_codec_carries_all_of_its_range(name: str) -> None:
    codec, channels = codec_of(name), sensor(name).channels
    ends = np.array([c.range for c in channels])
    signal = np.stack([np.tile(ends * share, (len(spec_of(name).elements), 1))
                       for share in np.linspace(-1, 1, 12)])  # fmt: skip
    samples = decode(codec, join(codec, codec.encode(chunk_of(codec, signal))))
    values, valid = stacked(samples, "values"), stacked(samples, "valid")
    assert values is not None and valid is not None
    n = len(values)
    assert n >= 10 and valid.all()
    steps = np.maximum([c.resolution for c in channels], np.abs(signal[-n:]) * 1e-6)
    assert (np.abs(values - signal[-n:]) <= 0.51 * steps).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_touch_is_well_above_the_noise_and_within_the_range(
    name: str, sweep: Callable[[str], Chunk]
) -> None:
    values, described = sweep(name).values, sensor(name)
    ends = np.array([c.range for c in described.channels])
    assert (np.abs(values) < 0.95 * ends).all()
    rest = np.median(values[:AT_REST], axis=0)
    assert (np.abs(values - rest) / described.noise()).max() > CLEAR


@pytest.mark.parametrize("name", NAMES)
def test_the_device_delivers_what_the_simulation_reads(
    name: str, sweep: Callable[[str], Chunk], tmp_path: Path
) -> None:
    array, sent = spec_of(name), sweep(name)
    file = tmp_path / "array.json"
    file.write_text(array.to_json())
    options = dict(parse_qsl(ROBOTS[name]))
    came: list[Chunk] = []
    with (
        FakeSerial(sent.values, options.pop("codec"), options=options, pace="fast") as device,
        open_source(f"{device.url}&array={file}&start_s=30") as source,
    ):
        assert source.spec == array

        def more() -> None:
            if (chunk := source.read(0.05)) is not None:
                came.append(chunk)

        until(lambda: sum(map(len, came)) >= len(sent), meanwhile=more)
    got = concatenate(came)
    assert len(got) == len(sent) and got.valid.all()
    steps = np.array([c.resolution for c in sensor(name).channels])
    assert (np.abs(got.values - sent.values) <= 0.51 * steps + 1e-6 * np.abs(sent.values)).all()


@pytest.mark.parametrize("name", ["mlx_hex", "rattechan"])
def test_the_chip_looks_along_the_whisker(name: str, sweep: Callable[[str], Chunk]) -> None:
    """At rest there is no field across it, and along it a few mT."""
    rest = np.median(sweep(name).values[:AT_REST], axis=0)
    assert (np.abs(rest[:, :2]) < 2e-5).all()
    assert ((rest[:, 2] > 2e-3) & (rest[:, 2] < 6e-3)).all()


def test_drag_bends_the_second_bridge_and_the_grid_is_that_of_the_wires() -> None:
    """The firmware's first whisker is the grid's last, its last the first (`ch_map_sim_v1.csv`)."""
    array = load_array("hx711_whisker")
    places = {w.name: (w.row, w.column) for w in array.whiskers}
    assert (places["W8"], places["W5"], places["W0"]) == ((0, 0), (0, 1), (2, 2))
    for w in array.whiskers:
        x, y = w.orientation[:, 0], w.orientation[:, 1]
        np.testing.assert_allclose((x, np.abs(y)), ([1, 0, 0], [0, 0, 1]), atol=1e-4)
        push = -np.array([0.0, 1.0, 0.0])  # on the tip, N: as things that pass along -y
        my = float(np.cross(0.08 * x, push) @ y)
        assert abs(my) == pytest.approx(0.08, rel=1e-3), "all of it about the whisker's y"
    first, second = sensor("hx711_whisker").channels
    assert (set(first.of), set(second.of)) == ({"mz"}, {"my"})


@pytest.mark.parametrize("name", NAMES)
def test_its_whiskers_whisk(name: str) -> None:
    with open_source(f"whisking:{name}?seconds=0.05&pace=fast") as source:
        values = np.concatenate([chunk.values for chunk in source])
    assert len(values) == 50 and np.isfinite(values).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_page_says_how_to_begin(name: str) -> None:
    page = ROOT / "docs" / "reference" / "published-arrays.md"
    (row,) = [r for r in page.read_text("utf-8").splitlines() if r.endswith(f"{ROBOTS[name]}` |")]
    spec = spec_of(name)
    channels = f"`{' '.join(spec.channels)}`, {spec.units[0]}"
    assert row.startswith(f"| `{name}` |") and f"| {channels} | {spec.rate_hz:g} |" in row


def test_the_page_s_commands_begin_projects(
    call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = ROOT / "docs" / "reference" / "published-arrays.md"
    monkeypatch.chdir(tmp_path)
    begun = re.findall(r"^\| `(\w+ --array .*?)` \| (\d)", page.read_text("utf-8"), re.M)
    assert len(begun) == len(ROBOTS)
    for words, kinds in begun:
        folder, _, name, *_ = words.split()
        assert call("new", *words.split())[0] == 0
        assert (tmp_path / folder / "array.toml").read_text("utf-8") == robot_text(name)
        sweeps = (tmp_path / folder / "sweeps.toml").read_text("utf-8")
        (categories,) = re.findall(r"^categories = \[(.*)\]", sweeps, re.M)
        assert len(categories.split(",")) == int(kinds)


def test_objects_are_no_smaller_than_an_array() -> None:
    assert usual_size(load_animals("mouse")) == Sweep.size_mm
    assert usual_size(load_animals("mlx_hex")) == Sweep.size_mm
    assert usual_size(load_animals("hx711_whisker")) == 66
