"""Boards that print numbers."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.ascii_line import AsciiLine, AsciiLineOptions
from tactile_rt.drivers.codecs.ascii_mapping import UNITS
from tactile_rt.drivers.codecs.ascii_text import Names
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

EXAMPLE = Path(__file__).parents[3] / "docs" / "codecs" / "ascii_line.toml"
PLAIN = "A0.fx,A0.fy,B1.fx,B1.fy"


def ascii_line(columns: str = PLAIN, **options: object) -> AsciiLine:
    return AsciiLine(AsciiLineOptions(columns=columns, **options))


def signal(n: int = 30, elements: int = 2) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, elements, 2))


class TestPlain(CodecContract):
    case = CodecCase(ascii_line, signal, checked=False)


class TestCountedAndTimed(CodecContract):
    case = CodecCase(
        lambda: ascii_line("count:8,time:us:24,A0.fx*0.5:mN,A0.fy*-2e-3:mN,-"),
        lambda: 1e-3 * signal(300, 1),
        checked=False,
    )


class TestSeconds(CodecContract):
    case = CodecCase(
        lambda: ascii_line("A0.fx:gf,time*0.01:s,A0.fy"), lambda: signal(30, 1), checked=False
    )


class TestExample(CodecContract):
    """The documented file."""

    case = CodecCase(
        lambda: AsciiLine(AsciiLineOptions(mapping=str(EXAMPLE))),
        lambda: np.random.default_rng(2).normal(size=(30, 2, 3)) * [0.01, 0.01, 1] + [0, 0, 297],
        1e-4 * np.array([0, 0, 1]),
        checked=False,
    )


# What sketches print, typed by hand: a banner, a header, all separators, all line ends, signs,
# exponents, missing and superfluous numbers, and what Arduino prints for numbers that are none.
PRINTED = (
    b"72,-1,0.5,3\r\n"  # the end of a line that was 1172,-1,0.5,3
    b"\r\n"
    b"Whisker board v1.2, 4 channels\r\n"
    b"fx\tfy\tfx\tfy\n"
    b"1 -2.5 +3e-1 4\r"
    b"  5,6;7\t8  \n\n"
    b"9, 10, 11\n"
    b"nan inf ovf 12\n"
    b"13,14,15,16\r\n"
    b"17,1x8,19,20\r\n"
    b"1_0,2,3,4\r\n"
    b"21,22,23,24,25\r\n"
    b".5 -.5 5. 1E2\r\n"
    b"3.5,unfinished"
)


def test_what_boards_print() -> None:
    codec = ascii_line()
    samples = codec.feed(PRINTED, T0)
    assert codec.spec is not None and codec.spec.grid == ((0, 0), (1, 1))
    good = [
        [1, -2.5, 0.3, 4], [5, 6, 7, 8], [np.nan, np.inf, np.nan, 12], [13, 14, 15, 16],
        [0.5, -0.5, 5, 100],
    ]  # fmt: skip
    assert np.array_equal(
        samples.values, np.array(good, np.float32).reshape(5, 2, 2), equal_nan=True
    )
    assert samples.valid.tolist() == [[True] * 2, [True] * 2, [False, False], *[[True] * 2] * 2]
    assert samples.damaged.tolist() == [0, 0, 1, 0, 3]
    assert codec.stats.corrupt == 4 and codec.stats.intact == 5
    assert codec.stats.skipped == len("72,-1,0.5,3Whisker board v1.2, 4 channelsfx fy fx fy")
    after = codec.feed(b"\n1,2,3,4\n", T0)  # 'unfinished' is one word of two: no banner
    assert after is not None and after.damaged.tolist() == [1]


def test_the_documented_example_means_what_it_says() -> None:
    codec = AsciiLine(AsciiLineOptions(mapping=str(EXAMPLE)))
    spec = codec.spec
    assert spec.name == "two-whiskers" and spec.elements == ("A0", "A1")
    assert spec.channels == ("fx", "fy", "temperature") and spec.units == ("N", "N", "K")
    assert spec.positions[1] == (0.0, 0.002, 0.0) and spec.rate_hz == 100.0
    line = "12345678 4021  12.5 -3.0 24.6  0.5 7.25 24.5  1"
    assert f"#   {line}\n" in EXAMPLE.read_text()
    samples = codec.feed(f"\n{line}\n".encode(), T0)
    assert samples.values[0] == pytest.approx(
        np.array([[6.25e-3, -1.5e-3, 297.75], [0.25e-3, 3.625e-3, 297.65]]), rel=1e-6
    )
    assert samples.ticks.tolist() == [12345678] and samples.count.tolist() == [4021]
    assert (codec.tick_ns, codec.tick_bits, codec.count_bits) == (1000.0, 32, 16)
    text = EXAMPLE.read_text()
    assert all(unit in text for unit in UNITS if unit not in ("N m", "g", "1"))


def test_a_board_is_started_stopped_and_polled() -> None:
    host = AsciiLine(AsciiLineOptions(mapping=str(EXAMPLE)))
    device = AsciiLine(AsciiLineOptions(mapping=str(EXAMPLE)))
    assert not device.streaming and not host.polls
    (start,), (stop,) = host.commands(Command.START), host.commands(Command.STOP)
    assert start.send == b"s\n" and stop.send == b"e\n"
    for part in (b"s", b"\n"):  # in pieces, as a line brings it
        device.respond(part)
    assert device.streaming
    device.respond(stop.send)
    assert not device.streaming

    asked = ascii_line(poll="r\n")
    assert asked.polls and not asked.streaming
    (poll,) = asked.commands(Command.POLL)
    asked.respond(poll.send * 2)
    assert asked.polled == 2 and not asked.streaming
    assert ascii_line().streaming and ascii_line().commands(Command.START) == ()


def test_a_name_before_a_number_may_stand_there() -> None:
    line = b"\nt:5, x=1.5 y: 2\tz_2 = 3 w4:4\n"
    samples = ascii_line("-,A0.a,A0.b,A0.c,A0.d").feed(line, T0)
    assert samples is not None and samples.values.tolist() == [[[1.5, 2.0, 3.0, 4.0]]]


@pytest.mark.parametrize(
    ("line", "rest"),
    [
        ("X:1X:3,Y:4", "X:3,Y:4"),
        ("X:1,Y:2X:3,Y:4", "X:3,Y:4"),
        ("Y:2X:3,Y:4", "X:3,Y:4"),
        ("Y:2X:3", ""),  # in another order, and whole
        ("X:2Y:3", ""),
    ],
)
def test_a_sample_breaks_off_where_a_name_comes_again(line: str, rest: str) -> None:
    assert Names({"X": 0, "Y": 1}).cut_glued(line) == rest


def test_a_comma_in_a_labelled_number_is_ambiguous_unless_numbers_are_counted() -> None:
    for names, line, doubt in (
        ({"F(N)": 0, "T": 1}, "F(N):4,25 T:23.5", "4,25"),
        ({"F": 0}, "12:00:05,900 -> F: -8,43", "-8,43"),
        ({"Raw.0": 0, "Raw.1": 1}, "Raw: 1,2", ""),
        ({"acc": 0}, "acc:[1,2,3]", ""),
        ({"x": 0, "y": 1}, "x:1,y:2", ""),
    ):
        found = Names(names)
        assert found.find(line) and found.ambiguous == doubt, line


def test_a_count_that_is_none_is_damage() -> None:
    codec = ascii_line("count,time:ms,A0.fx")
    lines = b"\n5,10,1\n6.5,20,1\nnan,30,1\n8,inf,1\n1e99,50,1\n-1,60,1\n"
    samples = codec.feed(lines, T0)
    assert samples is not None and samples.count.tolist() == [5, 2**32 - 1]
    assert samples.damaged.tolist() == [0, 4] and samples.ticks.tolist() == [10, 60]


def test_decimal_seconds_keep_their_microseconds() -> None:
    codec = ascii_line("time:s,A0.fx")
    samples = codec.feed(b"\n1.000001,0\n4294.967299,0\n", T0)
    assert samples is not None and samples.ticks.tolist() == [1_000_001, 4_294_967_299]
    hundredths = ascii_line("time*0.01:s,A0.fx").feed(b"\n150.25,0\n", T0)
    assert hundredths is not None and hundredths.ticks.tolist() == [1_502_500]


def test_a_line_without_end_does_not_pile_up() -> None:
    whole, cut = ascii_line(), ascii_line()
    stream = b"\n" + b"1," * 3000 + b"\n1,2,3,4\n"
    a = decode(whole, stream)
    b = decode(cut, stream, range(1, len(stream)))
    for codec, got in ((whole, a), (cut, b)):
        assert stacked(got, "damaged").tolist() == [1]
        assert codec.stats.corrupt == 1 and codec.stats.skipped == 6000


def test_invalid_elements_stay_invalid_on_the_wire() -> None:
    codec = ascii_line()
    chunk = chunk_of(codec, signal(3))
    chunk.valid[1, 0] = False
    packets = codec.encode(chunk)
    assert packets[1].startswith(b"nan,nan,")
    samples = ascii_line().feed(b"".join(packets), T0)
    assert samples is not None and np.array_equal(samples.valid, chunk.valid)


@given(
    st.lists(
        st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=4, max_size=4),
        min_size=1, max_size=5,
    ),
    st.lists(st.sampled_from([b",", b" ", b"\t", b"; ", b" , "]), min_size=3, max_size=3),
    st.sampled_from([b"\n", b"\r\n", b"\r", b"\n\n"]),
)  # fmt: skip
def test_any_numbers_with_any_separators(rows, gaps, end):
    lines = []
    for row in rows:
        words = [repr(x).encode() for x in row]
        lines.append(words[0] + b"".join(g + w for g, w in zip(gaps, words[1:], strict=True)))
    codec = ascii_line()
    samples = codec.feed(end + end.join(lines) + end, T0)
    assert np.array_equal(samples.values.reshape(-1, 4), np.array(rows, np.float32))
    assert codec.stats.corrupt == codec.stats.skipped == 0


BAD_COLUMNS = [
    ("A0fx", "columns[0]: 'A0fx' is no column: write ELEMENT.CHANNEL"),
    ("A0.fx,A0.fx", "columns: A0.fx appears twice"),
    ("A0.fx,A1.fy", "columns: no column A0.fy; every element needs every channel"),
    ("A0.fx:ozf", "columns[0]: unknown unit 'ozf'; there are N, mN"),
    ("A0.fx*big", "columns[0]: scale must be a number other than 0, not 'big'"),
    ("count:99,A0.fx", "columns[0]: a counter must have 1 to 53 bits, not 99"),
    ("count,A0.fx,count", "columns: count appears twice"),
    ("A0.fx:mN,A1.fx:mT", "columns: A1.fx is in T, but another fx in N"),
    ("count,-", "columns: no column measures anything"),
    ("time*2:ms,A0.fx", "columns[0]: 'time*2:ms' is no column"),
]


@pytest.mark.parametrize(("columns", "message"), BAD_COLUMNS)
def test_bad_columns_are_named(columns: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        ascii_line(columns)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


BAD_FILES = [
    ("rate_hz = 5.0", " needs a key 'columns'"),
    ('columns = ["A0.fx"]\nrate = 5.0', "2: the file has no key 'rate'; did you mean rate_hz?"),
    ('columns = ["A0.fx"]\nrate_hz = -1.0', " array 'ascii_line': rate_hz must be positive"),
    ('columns = ["A0.fx", "A0:fy"]', " columns[1]: 'A0:fy' is no column"),
    ('columns = ["A0.fx"]\nversion = 2', "2: version: this release reads 1, not 2"),
    ('columns = ["A0.fx"]\n[elements.B1]', " elements.B1 has no column"),
    (
        'columns = ["A0.fx", "A1.fx"]\n[elements.A1]\ngrid = [0, 0]',
        " array 'ascii_line': grid repeat",
    ),
]


@pytest.mark.parametrize(("text", "message"), BAD_FILES)
def test_bad_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "board.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        AsciiLine(AsciiLineOptions(mapping=str(path)))
    assert str(error.value).startswith(f"{path}:{message}") and "\n" not in str(error.value)


def test_other_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="needs either mapping=FILE"):
        AsciiLineOptions()
    with pytest.raises(ConfigError, match="needs either mapping=FILE"):
        AsciiLineOptions(mapping="a.toml", columns="A0.fx")
    with pytest.raises(ConfigError, match="rate_hz must be positive, not -1"):
        AsciiLine(AsciiLineOptions(columns="A0.fx", rate_hz=-1.0))
