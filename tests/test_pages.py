"""Every page that says how something is done is followed, so that it cannot rot; and no link in any
page leads nowhere."""

import os
import re
import warnings
from pathlib import Path

import pytest

import tactile_rt
from tests.helpers.commands import commands, options_of
from tests.helpers.followed_page import follow
from tests.helpers.notebooks import read_cells
from tests.helpers.source_tree import ROOT

DOCS = ROOT / "docs"

FOLLOWED = sorted([*DOCS.glob("how-to/add-a*.md"), *DOCS.glob("start/*.md")])
# What a page needs beyond the onboard packages.
NEEDS = {
    "add-a-network-cell": ("torch",),
    "add-a-recipe": ("mujoco", "torch"),
    "add-an-object-category": ("mujoco", "trimesh"),
    "add-a-whisker-species": ("mujoco",),
    "stimuli-to-alignment": ("torch",),
}
LONG = ("add-a-recipe", "stimuli-to-alignment")  # they train, and whisk
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *NOTEBOOKS])
LINK = re.compile(r"(?<!`)\]\(([^)\s]+)\)|<img[^>]+src=\"([^\"]+)\"")


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem in LONG)) for p in FOLLOWED],
)
def test_the_page_does_what_it_says(page: Path, tmp_path, monkeypatch) -> None:
    for module in NEEDS.get(page.stem, ()):
        pytest.importorskip(module)
    here = tmp_path / "here"
    here.mkdir()
    follow(page, here, monkeypatch)


def test_a_page_that_lies_is_caught(tmp_path, monkeypatch) -> None:
    page = ROOT / "docs" / "start" / "of-a-test.md"
    for text, said in (
        ("```python\nprint(1 + 1)\n```\n\n```text\n3\n```\n", "of-a-test.md:5: AssertionError"),
        ("```python\nraise ValueError(7)\n```\n", "of-a-test.md:1: ValueError: 7"),
        ("```sh\nfalse\n```\n", "of-a-test.md:1"),
        ("```sh\ntactile-rt no-such-command\n```\n", "exit code 2"),
    ):
        here = tmp_path / str(abs(hash(text)))
        here.mkdir()
        monkeypatch.setattr(Path, "read_text", lambda self, *a, text=text: text)
        with monkeypatch.context() as patch, pytest.raises(AssertionError, match=said):
            follow(page, here, patch)


def text_of(page: Path) -> str:
    """Return the text of a page; of a notebook that of its cells, code between fences."""
    if page.suffix == ".md":
        return page.read_text("utf-8")
    texts = ((cell["cell_type"] == "code", cell["source"]) for cell in read_cells(page))
    return "\n\n".join(f"```python\n{text}\n```" if code else text for code, text in texts)


def anchors(page: Path) -> set[str]:
    """What headings of a page are linked by, as GitHub makes it of their words."""
    text = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", h) for h in headings)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_link_leads_nowhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S)
    dead = []
    for match in LINK.finditer(text):
        target = match[1] or match[2]
        if "://" in target:  # of others: what it looks like, not whether it is there
            if not re.fullmatch(r"https://[a-z0-9.-]+\.[a-z]+(/\S*)?", target):
                dead.append(target)
            continue
        path, _, anchor = target.partition("#")
        there = Path(os.path.normpath(page.parent / path)) if path else page
        if not there.exists():
            dead.append(target)
        elif anchor and there in PAGES and anchor not in anchors(there):
            dead.append(target)
    assert dead == []


# commands

CALL = re.compile(r"(?<![\w./-])tactile-rt((?: +[^\s|;&>`#)]+)*)")
DECIDED = ROOT / "docs" / "decisions"  # what was said then


@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if DECIDED not in p.parents and p.name != "CHANGELOG.md"],
    ids=lambda p: p.relative_to(ROOT).as_posix(),
)
def test_every_command_of_a_page_is_there_with_its_options(page: Path) -> None:
    every = commands()
    groups = {name.partition(" ")[0] for name in every if " " in name}
    wrong = []
    for call in CALL.findall(text_of(page).replace("\\\n", " ")):
        words = call.split()
        names = [w for w in words if re.fullmatch(r"[a-z][a-z0-9-]*", w)][:2]
        name = " ".join(names) if names and names[0] in groups else "".join(names[:1])
        asked = [w.partition("=")[0] for w in words if w.startswith("--")]
        if (words and words[0].startswith("-")) or not names or words[0] != names[0]:
            continue  # of the program itself, or prose
        if name in groups:
            continue  # all of its commands
        if name not in every:
            wrong.append(f"{call.strip()}: no command {name!r}")
            continue
        negated = {o for p in every[name].params for o in p.secondary_opts}
        known = {*options_of(every[name]), "--help", *negated}
        wrong += [f"{call.strip()}: no option {one}" for one in asked if one not in known]
    assert wrong == []


def test_every_page_is_in_the_site_s_navigation() -> None:
    listed = set(re.findall(r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.M))
    pages = [*DOCS.rglob("*.md"), *NOTEBOOKS]
    there = {p.relative_to(DOCS).with_suffix(".md").as_posix() for p in pages}
    assert {p for p in there if not p.startswith("decisions/")} == listed


def test_every_decision_is_in_the_index_by_its_number_and_title() -> None:
    index = (DECIDED / "README.md").read_text("utf-8")
    listed = re.findall(r"^\| (\d+) \| \[(.+?)\]\((\S+)\) \| \S", index, re.M)
    pages = sorted(DECIDED.glob("0*.md"))
    titles = [page.read_text("utf-8").partition("\n")[0].removeprefix("# ") for page in pages]
    assert sorted(listed, key=lambda line: int(line[0])) == [
        (str(number), title, page.name)
        for number, (title, page) in enumerate(zip(titles, pages, strict=True), 1)
    ]
    for number, (title, page) in enumerate(zip(titles, pages, strict=True), 1):
        words = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        assert page.name == f"{number:04d}-{words}.md"


def test_the_face_is_told_whole() -> None:
    page = (DOCS / "reference" / "api" / "face.md").read_text("utf-8")
    told = {name.rpartition(".")[2] for name in re.findall(r"^::: (\S+)$", page, re.M)}
    told |= set(re.findall(r"`(\w+)`", page))
    assert set(tactile_rt.__all__) <= told


def test_the_site_is_built_offline_without_a_warning(tmp_path, monkeypatch, capfd) -> None:
    """Its own checks: pages, links and anchors, names of the API, arguments in docstrings."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("material")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.chdir(ROOT)
    with warnings.catch_warnings(action="ignore"):  # of its plugins
        build(load_config("mkdocs.yml", strict=True, site_dir=str(tmp_path)))
    assert (tmp_path / "reference" / "api" / "face.html").stat().st_size > 20_000
    for notebook in NOTEBOOKS:
        page = tmp_path / "notebooks" / f"{notebook.stem}.html"
        shown = re.findall(r"<img alt=\"([^\"]+)\" src=\"([\w-]+\.png)\"", page.read_text("utf-8"))
        assert len(shown) >= 3 and all((page.parent / name).is_file() for _, name in shown)
    for page in (p.read_text("utf-8") for p in tmp_path.rglob("*.html")):
        fetched = re.findall(r"(?:src|<link[^>]*href)=\"(https?://[^\"]+)", page)
        assert fetched == [], "a page that is read offline fetches nothing"
        assert not re.search(r"<thead>\s*<tr>(\s*<th[^>]*></th>)+\s*</tr>", page), "an empty band"
