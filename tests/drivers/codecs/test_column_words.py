"""Columns in words, of which one stands for many."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.column_words import compress_columns, expand_columns


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
