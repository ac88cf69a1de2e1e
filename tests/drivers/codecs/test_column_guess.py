"""What columns of names and numbers may be."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.column_guess import guess_columns, guess_line_columns
from tactile_rt.drivers.codecs.column_words import compress_columns, expand_columns
from tactile_rt.drivers.opening import make_codec

N = 40


def lines(form: str) -> bytes:
    """Lines cut at both ends, in which t is a time in ms, and a, b are measured."""
    text = "".join(
        form.format(k=k, t=10 * k, s=0.01 * k, a=k * k % 17, b=0.5 - k % 7) for k in range(N)
    )
    return text.encode()[3:-3]


@pytest.mark.parametrize(
    ("form", "columns"),
    [
        ("{a} {b}\r\n", "T{0..1}.value"),
        ("{t},{a},{b}\n", "time:ms,T{0..1}.value"),
        ("{k}\t{s:.4f}\t{a}\t{b}\n", "count,time:s,T{0..1}.value"),
        ("2024-05-10 09:48:16.{t:03d}  {a}  {b}\n", "time:iso,T{0..1}.value"),
        ("Fx: \u2212{a}.5 N, Fy: {b} N\n", "Fx=S.fx:N,Fy=S.fy:N"),
        ("Fx: {a} N, Fy: {b} N\n", "Fx=S.fx:N,Fy=S.fy:N"),
        ("magX[{a}] magY[{b}]\r\n", "magX=S.bx:1,magY=S.by:1"),
        ("X: {a} uT\r\nY: {b} uT\r\n", "Y=S.y:1,X=S.x:1"),
        ('{{"t": {t}, "f": {{"x": {a}, "y": {b}}}}}\n', "t=time:ms,f.x=S.fx:N,f.y=S.fy:N"),
        ("left:{a}\tright:{b}\r\n", "left=left.value:1,right=right.value:1"),
        ("{t},{a},kg,\n", "time:ms,T0.value,-"),
        ("Force(N):{a} Temp(C):{b}\r\n", "Force(N)=S.force:N,Temp(C)=S.temperature:degC"),
        ("Force [N] = {a}; Temp [C] = {b}\n", "Force [N]=S.force:N,Temp [C]=S.temperature:degC"),
        ("Load(kg): {a} kg Gap(mm): {b}\n", "Load(kg)=S.force:kgf,Gap(mm)=S.gap:mm"),
        ("Weight(g): {a} Temp(F): {b}\n", "Weight(g)=S.force:gf,Temp(F)=S.temperature:1"),
        ("Humidity: {a}, Temp: {b}\n", "Humidity=S.humidity:1,Temp=S.temperature:1"),
        ("Force (N): {a}\r\n", "Force (N)=S.force:N"),
        ("Temp:\t{a}\r\nForce:\t{b}\r\n---\n", "Force=S.force:1,Temp=S.temperature:1"),
    ],
)
def test_what_a_board_prints_has_columns_that_read_it(form, columns):
    data = lines(form)
    words = guess_line_columns(data)
    assert compress_columns(words) == columns
    codec = make_codec("serial", "ascii_line", {"columns": columns})
    codec.feed(data, 0)
    assert codec.stats.intact >= N - 3 and codec.stats.corrupt <= 1


@pytest.mark.parametrize("name", ["ms", "us", "s", "ns", "t_ms", "time_ms", "Time (ms)", "millis"])
def test_a_unit_of_time_names_a_time(name):
    words, timed = guess_columns([name, "Fx", "Fy"], [[5.0 * k, k % 7, k % 3] for k in range(N)])
    unit = name.strip(")").replace("millis", "ms").rpartition("_")[2].rpartition("(")[2]
    assert timed and words[0] == f"time:{unit}"


def test_of_several_lines_the_first_that_is_whole_begins_a_sample():
    printed = "".join(f"X: {k} uT\nY: {-k} uT\nZ: {k / 2} uT\n" for k in range(N)).encode()
    for cut, columns in ((0, "X=S.x:1,Y=S.y:1,Z=S.z:1"), (3, "Y=S.y:1,Z=S.z:1,X=S.x:1")):
        words = guess_line_columns(printed[cut:])
        assert compress_columns(words) == columns


@pytest.mark.parametrize(
    "form",
    [
        "Nov 24 18:37:16 host sshd[{t}]: Accepted password for bob from 10.0.0.{a} port {t}\n",
        "[{s:12.6f}] usb 1-{a}: new full-speed USB device number {k} using xhci_hcd\n",
        "2024-05-10 09:48:16.{t:03d} INFO worker {k} has finished {a} of the jobs\n",
        "def function{k}(argument: int = {a}) -> float:\n    return {b}\n",
        "no number at all in this line of text\n",
    ],
)
def test_a_log_in_words_has_none(form):
    assert guess_line_columns(lines(form)) is None


def guessed(names: list[str], first: list[float], step: list[float]) -> list[str]:
    rows = [[a + k * d for a, d in zip(first, step, strict=True)] for k in range(20)]
    return guess_columns(names, rows)[0]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["timestamp_ms", "Fx [N]", "Fy [N]"], ["time:ms", "S.fx:N", "S.fy:N"]),
        (["time", "wrench.force.x", "wrench.torque.x"], ["time:s", "S.fx:N", "S.mx:Nm"]),
        (["t", "p0_x", "p1_x"], ["time:s", "p0.x:1", "p1.x:1"]),
        (["%time", "field.header.seq", "field.wrench.force.x"], ["time:s", "-", "S.fx:N"]),
        (["Time (s)", "Force X (mN)", "note"], ["time:s", "S.fx:mN", "-"]),
        (["t", "bx0", "bx1"], ["time:s", "S0.bx:1", "S1.bx:1"]),
        (["x", "taxel0", "taxel1"], ["-", "taxel0.value:1", "taxel1.value:1"]),
        (["a", "taxel0", "taxel1"], ["a.value:1", "taxel0.value:1", "taxel1.value:1"]),
    ],
)
def test_names_say_what_is_what(names, words):
    assert guessed(names, [0.5, 3.25, 1.5], [0.01, 0.3, -0.7]) == words


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (1.7e9, 0.01, "s"), (1.7e12, 10, "ms"), (1.7e15, 10_000, "us"), (1.7e18, 1e7, "ns"),
        (0, 10, "ms"), (0, 10_000, "us"), (12.5, 0.01, "s"),
    ],
)  # fmt: skip
def test_the_unit_of_a_time_is_told_by_its_size(first, step, unit):
    assert guessed(["time", "Fx"], [first, 0.5], [step, 0.1])[0] == f"time:{unit}"


@pytest.mark.parametrize("form", ["{} [{}]", "{}({})", "{}_{}", "{}:{}", "{} / {}", "{} {}"])
def test_the_unit_of_a_time_is_told_by_its_name(form):
    for unit, word in [("min", "*60:s"), ("h", "*3600:s"), ("sec", ":s"), ("\xb5s", ":us")]:
        words = guessed([form.format("Elapsed", unit), "Fx"], [0, 5], [9, 1])
        assert words == [f"time{word}", "S.fx:N"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time:s,A0.fx,A0.fy", ["time:s", "A0.fx", "A0.fy"]),
        ("T{0..3}.p:1", ["T0.p:1", "T1.p:1", "T2.p:1", "T3.p:1"]),
        ("T{2..0}.p", ["T2.p", "T1.p", "T0.p"]),
        ("(M{0..1}.bx:uT,M{0..1}.by:uT)", ["M0.bx:uT", "M0.by:uT", "M1.bx:uT", "M1.by:uT"]),
        ("p{1..2}_x=T{0..1}.fx", ["p1_x=T0.fx", "p2_x=T1.fx"]),
        ("c{08..10}=T{8..10}.raw", ["c08=T8.raw", "c09=T9.raw", "c10=T10.raw"]),
        ("-{1..3},A0.fx", ["-", "-", "-", "A0.fx"]),
        ('"Force, x"=A0.fx , y=A0.fy', ["Force, x=A0.fx", "y=A0.fy"]),
        ("temperature(C)=M0.temperature:degC", ["temperature(C)=M0.temperature:degC"]),
    ],
)
def test_a_list_is_its_words(text, words):
    assert list(expand_columns(text)) == words


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("(T{0..3}.x,T{0..2}.y)", "the ranges in .* are of different lengths: 3, 4"),
        ('"Fx=A0.fx', "a quote is not closed"),
        ("(T{0..3}.x", "a parenthesis is not closed"),
        ("T{0..999999}.x", "more than 100000 columns"),
    ],
)
def test_what_is_wrong_is_told(text, why):
    with pytest.raises(ConfigError, match=why):
        expand_columns(text)


WORD = st.from_regex(
    r"[A-Za-z][a-z_]{0,4}\d{0,3}(=[A-Z]\d{0,2}\.[a-z]{1,3}(:mN)?)?", fullmatch=True
)


@given(st.lists(st.one_of(WORD, st.just("-")), min_size=1, max_size=12))
def test_what_is_shortened_is_the_same(words):
    assert list(expand_columns(compress_columns(words))) == words


def test_taxels_become_short():
    words = [f"p{i:02d}=T{i}.fz:N" for i in range(36)]
    assert compress_columns(["time:s", *words]) == "time:s,p{00..35}=T{0..35}.fz:N"
