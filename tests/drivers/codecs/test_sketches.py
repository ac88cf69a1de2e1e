"""What well-known sketches print, and the words that describe it."""

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.ascii_line import AsciiLine, AsciiLineOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract

nan = np.nan

# Name: columns, what the board prints after its first line, and the samples: element by channel.
SKETCHES = {
    "Adafruit MLX90393, basicdemo": (
        "X=M0.bx:uT,Y=M0.by:uT,Z=M0.bz:uT",
        "Found a MLX90393 sensor\r\nX: 12.3000 uT\r\nY: -4.5000 uT\r\nZ: 60.0000 uT\r\n"
        "Unable to read XYZ data from the sensor.\r\n"
        "X: 13.0000 uT\r\nY: -5.0000 uT\r\nZ: 61.0000 uT\r\n",
        [[[12.3e-6, -4.5e-6, 60e-6]], [[13e-6, -5e-6, 61e-6]]],
    ),
    "Adafruit MLX90393, unified sensor": (
        "M0.bx:uT,M0.by:uT,M0.bz:uT,-",
        "X: 12.30 \tY: -4.50 \tZ: 60.00 \tuTesla \r\n\r\nX: 1.00 \tY: 2.00 \tZ: 3.00 \tuTesla \r\n",
        [[[12.3e-6, -4.5e-6, 60e-6]], [[1e-6, 2e-6, 3e-6]]],
    ),
    "SparkFun MLX90393": (
        "magX=M0.bx:uT,magY=M0.by:uT,magZ=M0.bz:uT,temperature(C)=M0.temperature:degC",
        "magX[12.30] magY[-4.50] magZ[60.00] temperature(C)[25.10]\r\n",
        [[[12.3e-6, -4.5e-6, 60e-6, 298.25]]],
    ),
    "HX711 library, full example": (
        "one reading=A0.fz:gf,average=A0.mean:gf",
        "Readings:\r\none reading:\t12.3\t| average:\t12.1\r\n",
        [[[0.12062180, 0.11866047]]],
    ),
    "SparkFun OpenScale": (
        "time:ms,A0.fz:kgf,-,-,-",
        "1234,6.78,kg,0,25.1,\r\n1334,-0.02,kg,0,25.1,\r\n",
        [[[66.489087]], [[-0.1961330]]],
    ),
    "JSON lines": (
        "t=time:ms,mag.x=M0.bx:uT,mag.y=M0.by:uT,mag.z=M0.bz:uT",
        '{"t": 100, "mag": {"x": 1.5, "y": null, "z": 3e1}, "state": "ok"}\r\n'
        '{"state": "ok", "mag": {"z": 3, "y": 2, "x": 1}, "t": 110}\r\n',
        [[[1.5e-6, nan, 30e-6]], [[1e-6, 2e-6, 3e-6]]],
    ),
    "Python list": ("A0.fx,B0.fx", "[0.25, -1.5]\n[1, null]\n", [[[0.25], [-1.5]], [[1], [nan]]]),
    "time of the host": (
        "time:iso,A0.fx,B0.fx",
        "2024-05-10 09:48:16.222  6.37 13.16\n2024-05-10 09:48:16.232  6.38 13.17\n",
        [[[6.37], [13.16]], [[6.38], [13.17]]],
    ),
    "Arduino serial plotter": (
        "A0.fx,B0.fx",
        "left:512\tright:498\r\nleft:513,right:499\r\n",
        [[[512], [498]], [[513], [499]]],
    ),
}  # fmt: skip


# What a search for what boards print found, when the reader of lines was finished.
FOUND = {
    "force-sensitive resistor, a page each time": (
        "Raw Value=A0.raw,Force=A0.fz:N",
        "Press the FSR sensor...\r\n\r\n--- FSR Data ---\r\nRaw Value: 512\r\nForce: 3.25 N\r\n"
        "⚠ IMPACT DETECTED!\r\n\r\n--- FSR Data ---\r\nRaw Value: 13\r\nForce: 0.00 N\r\n\r\n",
        [[[512, 3.25]], [[13, 0]]],
    ),
    "Infineon TLV493D, Cartesian": (
        "M0.bx:mT,M0.by:mT,M0.bz:mT",
        "X = 0.10 mT; Y = -0.20 mT; Z = 1.00 mT\r\n",
        [[[1e-4, -2e-4, 1e-3]]],
    ),
    "BME280 with a spinner": (
        "Temperature=S.temperature:degC,Pressure=S.pressure*0.1:kPa",
        "\rConnecting to BME280 |\rConnecting to BME280 /Temperature = 25.00 °C\r\n"
        "Pressure = 1013.25 hPa\r\nHumidity = 40.00 %\r\nApprox. Altitude = 12.00 m\r\n",
        [[[298.15, 101325]]],
    ),
    "three flex sensors": ("A0.x,B0.x,C0.x", "FLEX:512,513,514\r\n", [[[512], [513], [514]]]),
    "Adafruit MLX90393, for MotionCal": (
        "Raw.6=M0.bx*0.1:uT,Raw.7=M0.by*0.1:uT,Raw.8=M0.bz*0.1:uT",
        "Raw:0,0,0,0,0,0,-104,55,7\r\nUni:0,0,0,0,0,0,-10,5,0\r\n",
        [[[-10.4e-6, 5.5e-6, 0.7e-6]]],
    ),
}  # fmt: skip


def board(columns: str) -> AsciiLine:
    return AsciiLine(AsciiLineOptions(columns=columns))


@pytest.mark.parametrize("name", [*SKETCHES, *FOUND])
def test_a_sketch_is_described_in_a_line(name: str) -> None:
    columns, printed, expected = (SKETCHES | FOUND)[name]
    codec = board(columns)
    samples = codec.feed(b"\r\n" + printed.encode(), T0)
    assert samples.values == pytest.approx(np.array(expected), rel=1e-6, nan_ok=True)
    assert samples.valid.tolist() == np.isfinite(expected).all(axis=2).tolist()
    assert codec.stats.corrupt == 0


@pytest.mark.parametrize("lost", range(4))
def test_of_several_lines_none_comes_into_another_sample(lost: int) -> None:
    lines = [f"{name}: {k}\n".encode() for k in range(1, 5) for name in "XYZ"]
    codec = board("X=A0.bx,Y=A0.by,Z=A0.bz")
    samples = codec.feed(b"joined\n" + b"".join(lines[lost:]), T0)
    told = samples.values[:, 0].tolist()
    assert told == [[k, k, k] for k in range(2 if lost else 1, 5)]
    assert codec.stats.corrupt == 0
    codec.forget()
    samples = codec.feed(
        b"joined\n" + b"".join(lines[:3] + lines[4:] + [b"\0\0\0\n", b"-1.5\n"]), T0
    )
    told = (codec.stats.incomplete, codec.stats.corrupt, codec.passed)
    assert told == (1, 1, 1 + (lost in (1, 2)))
    assert samples.valid[:, 0].tolist() == [True, False, True, True]
    assert samples.values[2, 0].tolist() == [3, 3, 3]


def test_times_are_the_boards() -> None:
    codec = board(SKETCHES["time of the host"][0])
    samples = codec.feed(b"\n" + SKETCHES["time of the host"][1].encode(), T0)
    assert np.diff(samples.ticks).tolist() == [10_000] and codec.tick_ns == 1000.0
    midnight = board("time:iso,A0.fx").feed(b"\n23:59:59.750 -> 5\n9:00:00 6\n", T0)
    assert midnight.ticks.tolist() == [86_399_750_000, 32_400_000_000]


@pytest.mark.parametrize(
    "columns, line, complaint",
    [
        ("A0.fx,A0.fy", "1.5 uT 2.5x1", "line '1.5 uT 2.5x1': column 2 (A0.fy) is 'uT', no number"),
        ("A0.fx,A0.fy", "1,2,3", "line '1,2,3' has 3 columns, 2 are described; column 3 is '3'"),
        ("A0.fx,A0.fy", "1", "line '1' has 1 columns, 2 are described; column 1 is '1'"),
        ("X=A0.fx", "Y: 5", "line 'Y: 5' has none of 'X'"),
        ("count,A0.fx", "1.5,2", "column 1 (count) is 1.5"),
        (
            "A0.fx,A0.fy",
            "1\t2\t3",
            r"line '1\t2\t3' has 3 columns, 2 are described; column 3 is '3'",
        ),
        ("A0.fx,A0.fy", "\x01\x80\x12\x7f\x03\x90", "what comes is not text: wrong baud rate?"),
        ("A0.fx,A0.fy", "\x01\x80\x12\n3", "what comes is not text: wrong baud rate?"),
        (
            "A0.fx,A0.fy",
            "\x01\x80\x12\n" + 99 * "ab\0c",
            "what comes is not text: wrong baud rate?",
        ),
    ],
)
def test_what_does_not_fit_is_told_with_its_line_and_column(columns, line, complaint) -> None:
    codec = board(columns)
    assert codec.feed(b"\n" + line.encode("latin-1") + b"\n", T0) is None
    assert codec.complaint == complaint


def test_a_missing_number_costs_its_element_and_not_the_sample() -> None:
    codec = board("A0.fx,A0.fy,B0.fx,B0.fy")
    samples = codec.feed(b"\n1,,3,4\n,2,3,4\n1,2,3,\nError 2 3 4\n1,2,n/a,4\n", T0)
    assert samples.valid.tolist() == [
        [False, True], [False, True], [True, False], [False, True], [True, False],
    ]  # fmt: skip
    assert codec.stats.corrupt == 0
    named = board("x=A0.fx,y=A0.fy,z=B0.fx,w=B0.fy")
    lines = b"\nx:1 y:2\nz:3\nw:4\nx:5 y:6 z:7\nx:8\ny:9\nz:10\nw:11\n"
    samples = named.feed(lines, T0)
    assert samples.valid.tolist() == [[True, True], [True, False], [True, True]]
    assert named.complaint == "'w' did not come"


@pytest.mark.parametrize(
    "text, message",
    [
        ("columns = ['x=A0.fx', 'A0.fy']", "give all columns a name, NAME=COLUMN, or none"),
        ("columns = ['x=A0.fx', 'x=A0.fy']", "'x' appears twice"),
        ("columns = ['=A0.fx']", "columns[0]: '=A0.fx' has no name before ="),
    ],
)
def test_mistakes_are_named(tmp_path, text, message) -> None:
    path = tmp_path / "board.toml"
    path.write_text(text + "\n")
    with pytest.raises(ConfigError) as error:
        AsciiLine(AsciiLineOptions(mapping=str(path)))
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)


def signal(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, 2, 2))


class TestNames(CodecContract):
    case = CodecCase(
        lambda: board("n=count:16,t=time:ms,a.x=A0.fx,a.y=A0.fy,b.x=B1.fx:mN,b.y=B1.fy:mN"),
        signal,
        checked=False,
    )


class TestNumbersAfterAName(CodecContract):
    case = CodecCase(
        lambda: board("Raw.6=A0.fx,Raw.7=A0.fy,Raw.8=B1.fx,Raw.9=B1.fy"), signal, checked=False
    )


class TestDates(CodecContract):
    case = CodecCase(lambda: board("time:iso,A0.fx,A0.fy,B1.fx,B1.fy"), signal, checked=False)
