"""The page of supported devices says of every codec what its owner needs."""

import re
import shlex

import pytest

from bench.pages.devices import PAGE, write_page
from tactile_rt.core.settings import split_url
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.opening import make_codec

TEXT = PAGE.read_text("utf-8")
ENTRIES = ["Wire and rate", "Measures", "Connect", "Losses", "Protocol from"]


def test_the_page_is_up_to_date() -> None:
    assert write_page() == TEXT, "python -m bench.pages.devices writes it anew"


def test_every_codec_has_a_row_with_its_wire() -> None:
    rows = re.findall(r"^\| \[.+?\]\(#.+?\) \| `([\w-]+)` \| (\w+)", TEXT, re.M)
    assert sorted(("can" if wire == "CAN" else "serial", name) for name, wire in rows) == sorted(
        CODECS
    )


def test_every_protocol_has_the_same_entries() -> None:
    sections = re.split(r"^### ", TEXT, flags=re.M)[1:]
    assert len(sections) == len({name for _, name in CODECS})
    for section in sections:
        assert re.findall(r"^\*\*(.+?)\*\*: \S", section, re.M) == ENTRIES


def test_every_url_is_taken() -> None:
    pytest.importorskip("cantools")
    urls = re.findall(r"^tactile-rt hz '(.+)' --seconds 5$", TEXT, re.M)
    assert len(urls) == len(CODECS) + len({name for _, name in CODECS})
    for scheme, _, fields in map(split_url, urls):
        make_codec(scheme, fields.pop("codec"), fields)


def test_every_twin_is_told_its_options() -> None:
    twins = re.findall(r"^tactile-rt emulate (.+)$", TEXT, re.M)
    assert {shlex.split(twin)[0] for twin in twins} == {name for _, name in CODECS}
