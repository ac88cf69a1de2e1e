"""The glossary, docs/reference/words.md: one word, one thing."""

import ast
import re

from tests.helpers.source_tree import ROOT, modules

PAGE = ROOT / "docs" / "reference" / "words.md"


def rows() -> list[tuple[str, str, str]]:
    """(word, what it is, in code) of every table."""
    lines = [x for x in PAGE.read_text("utf-8").splitlines() if x.startswith("| ")]
    cells = [tuple(c.strip() for c in x.strip("|").split(" |")) for x in lines]
    return [c for c in cells if c[0] != "word"]  # type: ignore[misc]


def classes() -> set[str]:
    """Of the package and of its rigs."""
    return {
        node.name
        for module in modules().values()
        for node, _ in module.nodes
        if isinstance(node, ast.ClassDef)
    }


def test_every_word_stands_once_and_is_explained() -> None:
    words = [word for word, *_ in rows()]
    assert len(words) > 50
    assert len(set(words)) == len(words)
    for word, meaning, _ in rows():
        assert len(meaning.split()) >= 5, word


def test_the_names_in_code_are_there() -> None:
    named = {name for *_, code in rows() for name in re.findall(r"`(\w+)`", code)}
    assert len(named) > 20
    assert named - classes() == set()
