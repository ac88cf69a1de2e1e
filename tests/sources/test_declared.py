"""`array=FILE`: real devices on their lines, said to be arrays whose names no codec knows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.calibration import Calibration, save_calibration
from tactile_rt.core.errors import ConfigError, SourceError, SpecMismatch
from tactile_rt.core.stream import ArraySpec, concatenate
from tactile_rt.drivers.codecs.native import NativeSerial
from tactile_rt.drivers.codecs.native_common import MessageType
from tactile_rt.drivers.device_source import device_of
from tactile_rt.recording import Recording
from tactile_rt.recording.checking import compare_decoding
from tactile_rt.sources.opening import check_model, check_source, open_source
from tactile_rt.testing import ArraySource, FakeCan, FakeSerial, cut_chunks, small_spec
from tests.helpers.recordings import record_device
from tests.helpers.waiting import PATIENCE_S, read_chunks

pytestmark = pytest.mark.usefixtures("no_thread_left")

N = 60


def array_of(elements: int, channels: str, units: str, name: str = "robot") -> ArraySpec:
    """Whiskers of a robot, on places of their own."""
    names = tuple(f"whisker{i}" for i in range(elements))
    return replace(
        small_spec(elements), name=name, elements=names, frame="plate",
        grid=tuple((i % 2, i) for i in range(elements)),
        positions=tuple((0.0, 0.01 * i, 0.02) for i in range(elements)),
        channels=tuple(channels.split()), units=tuple(units.split(",")),
    )  # fmt: skip


def write(path: Path, array: ArraySpec) -> Path:
    path.write_text(array.to_json())
    return path


def signal(elements: int, channels: int, size: float) -> np.ndarray:
    return np.random.default_rng(5).normal(size=(N, elements, channels)) * size


DEVICES = {
    "bota": (FakeSerial, {"temperature": "true"}, array_of(1, "fx mz", "N,N m"), [0, 5], 1.0, 1e-6),
    "anyskin": (FakeSerial, {}, array_of(5, "bx by bz", "T,T,T"), [0, 1, 2], 1e-4, 1e-9),
    "hx711_whisker": (
        FakeSerial, {"whiskers": "8", "reset": "false"}, array_of(8, "bridge1 bridge0", "V,V"),
        [1, 0], 1e-3, 1e-8,
    ),
    "ascii_line": (
        FakeSerial, {"columns": "A0.fx:mN,A1.fx:mN"}, array_of(2, "fx", "N"), [0], 1e-2, 1e-8,
    ),
    "xela": (FakeCan, {}, array_of(16, "z", "1"), [2], 0.0, 0.5),
}  # fmt: skip


@pytest.mark.parametrize("codec", DEVICES)
def test_a_device_is_the_array_that_it_is_said_to_be(codec: str, tmp_path: Path) -> None:
    make, options, array, picked, size, resolution = DEVICES[codec]
    file = write(tmp_path / "robot.json", array)
    own = check_source(f"{make.wire}:{'virtual:' * (make is FakeCan)}x?codec={codec}" + "".join(
        f"&{k}={v}" for k, v in options.items() if v != "false"
    ))  # fmt: skip
    values = signal(*own.shape, size)
    if "temperature" in own.channels:
        values[..., own.channels.index("temperature")] = 300.0
    if not size:
        values = np.random.default_rng(5).integers(1, 60_000, size=(N, *own.shape)).astype(float)
    with make(values, codec, options=options) as fake:
        url = f"{fake.url}&start_s={PATIENCE_S:g}&array={file}"
        known = check_source(url)
        with open_source(url) as source:
            assert source.spec == known == replace(array, rate_hz=own.rate_hz)
            assert device_of(source).spec == own
            got = concatenate(read_chunks(source, N - 5))
            assert source.stats.corrupt == source.stats.missing == 0
    expected = values[: len(got), :, picked]
    np.testing.assert_allclose(got.values, expected, rtol=1e-6, atol=resolution)
    assert got.valid.all()


def test_it_is_recorded_as_that_array_and_decoded_again_as_that(tmp_path: Path) -> None:
    array, path = array_of(1, "fz fx", "N,N"), tmp_path / "run.mcap"
    file = write(tmp_path / "robot.json", array)
    fake = FakeSerial(signal(1, 6, 1.0), "bota")
    chunks, _ = record_device(fake, path, N, suffix=f"&array={file}")
    file.unlink()  # the recording tells by itself
    expected = concatenate(chunks)
    assert Recording(path).spec == replace(array, rate_hz=100.0)
    for url in (f"replay:{path}?speed=0", f"replay:{path}?speed=0&from=wire"):
        assert check_source(url) == Recording(path).spec
        with open_source(url) as source:
            got = concatenate(list(source))
        assert np.array_equal(got.values, expected.values)
    found = compare_decoding(path)
    assert not found.array and found.equal == found.recorded == len(expected)
    # and what was recorded as one array can be said to be another afterwards
    other = write(tmp_path / "other.json", array_of(1, "fx", "N", "other"))
    with open_source(f"replay:{path}?speed=0&array={other}") as source:
        assert source.spec.name == "other"
        assert np.array_equal(concatenate(list(source)).values, expected.values[..., 1:])


class Mute(NativeSerial):
    """A device of ours that does not describe itself."""

    def respond(self, packet: bytes) -> bytes:
        if packet[2] & 15 == MessageType.DESCRIBE:
            return b""
        return super().respond(packet)


def test_a_native_device_that_says_nothing_is_told(tmp_path: Path, monkeypatch) -> None:
    array = array_of(3, "fy mz", "N,N m")
    file, path = write(tmp_path / "robot.json", array), tmp_path / "run.mcap"
    monkeypatch.setattr("tactile_rt.drivers.codecs.native.NativeSerial", Mute)
    values = signal(3, 2, 1.0)
    with FakeSerial(values, spec=small_spec()) as fake:
        with pytest.raises(SourceError, match="no answer to its description"):
            open_source(fake.url)
    fake = FakeSerial(values, spec=small_spec())
    chunks, _ = record_device(fake, path, N, suffix=f"&array={file}")
    assert np.array_equal(concatenate(chunks).values, values.astype(np.float32))
    file.unlink()
    about = Recording(path).description
    assert about.spec == array and about.calibration is None  # nothing stands between
    with open_source(f"replay:{path}?speed=0&from=wire") as source:
        assert source.spec == array
        assert np.array_equal(concatenate(list(source)).values, values.astype(np.float32))


def test_counts_are_calibrated_first_then_declared(tmp_path: Path) -> None:
    """Sixteen taxels in counts to newtons, by a gain, as pads of a hand."""
    taxels = check_source("can:virtual:x?codec=xela")
    gain = (1e-3, 1e-3, 2e-3)
    cell = replace(
        Calibration.of("pad", taxels), output_channels=("fx", "fy", "fz"),
        output_units=("N", "N", "N"), gain=gain,
    )  # fmt: skip
    array = array_of(16, "fz fx", "N,N")
    toml = save_calibration(cell, tmp_path / "pad.toml")
    file = write(tmp_path / "hand.json", array)
    counts = np.random.default_rng(1).integers(0, 65_536, size=(N, *taxels.shape))
    with FakeCan(counts, "xela") as fake:
        url = f"{fake.url}&start_s={PATIENCE_S:g}&calibration={toml}&array={file}"
        assert check_source(url) == replace(array, rate_hz=taxels.rate_hz)
        with open_source(url) as source:
            got = concatenate(read_chunks(source, N - 5))
    expected = (counts * gain)[: len(got), :, [2, 0]]
    np.testing.assert_allclose(got.values, expected, rtol=1e-6)
    with pytest.raises(SpecMismatch, match=r"has fz \(N\), fx \(N\), uSPa44 gives x \(1\)"):
        check_source(f"can:virtual:x?codec=xela&array={file}")


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("serial:x?codec=bota&array={}", "has 3 (whisker0, whisker1, whisker2), bota 1 (sensor)"),
        ("serial:x?codec=hx711_whisker&whiskers=3&array={}", "has fx (N), hx711_whisker gives br"),
        ("synthetic:4x6?array={}", "has 3 (whisker0, whisker1, whisker2), synthetic 4 (A0, A1,"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_opened(url, said, tmp_path: Path) -> None:
    file = write(tmp_path / "robot.json", array_of(3, "fx", "N"))
    for ask in (check_source, open_source):
        with pytest.raises(SpecMismatch) as caught:
            ask(url.format(file))
        assert said in str(caught.value)


def test_any_source_can_be_an_array(tmp_path: Path) -> None:
    file = write(tmp_path / "robot.json", array_of(3, "fx", "N"))
    with open_source(f"synthetic:3x6?pace=fast&array={file}") as source:
        assert source.spec.elements[0] == "whisker0" and source.read().values.shape[1:] == (3, 1)
    with open_source("synthetic:3x6?pace=fast", array=str(file)) as source:
        assert source.spec.name == "robot"
    with pytest.raises(ConfigError, match="the array is given twice"):
        open_source(f"synthetic:3x6?array={file}", array=str(file))
    with pytest.raises(ConfigError, match=r"none\.json"):
        check_source("synthetic:3x6?array=none.json")


def test_several_arrays_are_one_that_has_a_name(tmp_path: Path) -> None:
    head = tmp_path / "head.toml"
    head.write_text('name = "head"\nrate_hz = 500\n' + "".join(
        f'[[source]]\nname = "{n}"\nurl = "synthetic:2x3?pace=fast&seconds=0.1"\n' for n in "lr"
    ))  # fmt: skip
    assert check_source(f"combined:{head}").elements == ("l.A0", "l.A1", "r.A0", "r.A1")
    file = write(tmp_path / "robot.json", array_of(4, "fx fz", "N,N"))
    with open_source(f"combined:{head}?array={file}") as source:
        assert source.spec == check_source(f"combined:{head}?array={file}")
        assert source.spec.elements[3] == "whisker3" and source.spec.rate_hz == 500
    head.write_text(head.read_text().replace("synthetic:2x3", "serial:/dev/none?codec=native&x="))
    with pytest.raises(ConfigError, match="no option 'x'"):
        check_source(f"combined:{head}")


def test_a_model_s_file_says_what_array_it_is(tmp_path: Path) -> None:
    """Trained on a description, streamed by a codec: the shortest way from one to the other."""
    pytest.importorskip("onnx")
    from tests.helpers.tiny_model import write_model

    array = replace(array_of(3, "fy mz", "N,N m"), rate_hz=1000.0)
    model = write_model(tmp_path / "robot.onnx", spec=array.to_json())
    line = "serial:x?codec=ascii_line&columns=A0.fy:N,A0.mz:N m,A1.fy:N,A1.mz:N m,A2.fy:N,A2.mz:N m"
    with pytest.raises(SpecMismatch) as caught:
        check_model(model, line)
    said = str(caught.value)
    assert said.startswith(f"{line}: {model} was made for another array than 'ascii_line': ")
    assert "lacks whisker0, whisker1, whisker2" in said
    assert said.endswith(f"or declare it as the model's: array={model}")
    check_model(model, f"{line}&array={model}")  # as it says
    for url in ("serial:x?codec=native", f"serial:x?codec=native&array={model}"):
        check_model(model, url)  # the device will tell
    with pytest.raises(SpecMismatch) as caught:
        check_model(model, "serial:x?codec=bota")
    assert str(caught.value).endswith("; name a model of it")  # declared it cannot be


def test_it_is_one_source_with_all_that_the_device_has(tmp_path: Path) -> None:
    file = write(tmp_path / "robot.json", array_of(1, "fx", "N"))
    with FakeSerial(signal(1, 6, 1.0), "bota") as fake:
        with open_source(f"{fake.url}&start_s={PATIENCE_S:g}&array={file}") as source:
            assert concatenate(read_chunks(source, 10)).values.shape[1:] == (1, 1)
            assert source.stats.delivered >= 10 and source.health.connections == 1
    chunks = cut_chunks(np.zeros((3, 1, 6)), 1.0)
    assert device_of(ArraySource(check_source("serial:x?codec=bota"), chunks)) is None
