"""What a release says of itself to machines: addresses, version and licence are the same wherever
they stand, and the cards of model and data say what their pages say."""

import re
import tomllib
from pathlib import Path

import yaml

import tactile_rt
from tactile_rt.classifier.model_file import read_model, shipped_model
from tests.helpers.source_tree import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
SOURCE = PROJECT["urls"].get("Source")  # none until it is published
REFERENCE = ROOT / "docs" / "reference"
MODEL, DATA = REFERENCE / "mouse13.md", REFERENCE / "realtouch.md"


def parts(page: Path) -> tuple[dict, str]:
    """The card of a page, and the page below it."""
    _, card, text = page.read_text("utf-8").split("---\n", 2)
    return yaml.safe_load(card), text


def test_the_citation_is_of_this_release() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(cited)  # what the format demands
    assert cited["version"] == tactile_rt.__version__
    assert cited["license"] == PROJECT["license"]
    assert cited.get("repository-code") == SOURCE
    assert cited["keywords"] == PROJECT["keywords"]


def test_every_address_of_the_project_is_the_same_and_none_is_named_before_it_is_there() -> None:
    files = (*ROOT.glob("*.*"), *(ROOT / ".github").rglob("*.yml"))
    for file in filter(Path.is_file, files):
        named = re.findall(r"https://[\w.]*github[\w.]*/tactile[\w-]*/\w+", file.read_text("utf-8"))
        assert set(named) <= {SOURCE}, file


def test_the_model_says_its_licence() -> None:
    card, text = parts(MODEL)
    assert read_model(shipped_model())[0].license == PROJECT["license"]
    assert card["license"] == PROJECT["license"].lower()
    assert f"| licence | {PROJECT['license']}," in text


def test_the_model_s_card_has_the_figures_of_its_page() -> None:
    card, text = parts(MODEL)
    (model,) = card["model-index"]
    assert model["name"] == read_model(shipped_model())[0].name
    found = [float(m["value"]) for r in model["results"] for m in r["metrics"]]
    row = re.search(r"^\| shape, one sweep \|[^|]*\| \*\*([\d.]+)", text, re.M)
    fours = re.search(r"^\| two sweeps; four \|[^|]*\| [^;|]*; ([\d.]+)", text, re.M)
    upright = re.search(r"^\| upright; .*?\|.*?\| ([\d.]+)", text, re.M)
    assert row and fours and upright
    assert found == [float(one[1]) for one in (row, fours, upright)]


def test_the_data_s_card_says_how_many_sweeps_there_are() -> None:
    card, text = parts(DATA)
    rows = re.findall(r"^\| `\w+` \|[^|]*\| \d+ \| \d+ \| (\d+) \| (\d+|-) \|$", text, re.M)
    sweeps = sum(int(n) for row in rows for n in row if n != "-")
    assert len(rows) == 6
    assert card["size_categories"] == ["1K<n<10K"]
    assert 1_000 < sweeps < 10_000
    assert card["license"] == PROJECT["license"].lower()
