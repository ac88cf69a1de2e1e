"""Names and first lines read as NumPy's and ROS's do: see CONTRIBUTING, "Names and sentences"."""

import ast
import re
from collections.abc import Iterator

from tests.helpers.source_tree import FUNCTIONS, modules

WORDS = 15  # of a docstring's first sentence
# A function does something: its name is a verb. A true conversion may be a participle.
PARTICIPLE = re.compile(
    r"_*(?:(?!(?:feed|embed)$)[a-z]+ed|said|told|kept|heard|found|made|drawn|taken|given|sent|left|seen|felt"
    r"|built|shown|known|written|held|met|lost|meant|begun|of_[a-z_]+)"
)
# Its first line is an imperative: not a riddle about what comes out.
RIDDLE = re.compile(
    r"(?:Whether|What|Who|Whoever|Whose|Of|How|Which|Where|When|As|By|That|Those)\b"
)
UNCLEAR = re.compile(
    r"\b(?:is|are|was|were) (?:told|said|heard of|kept apart)\b|\bwhoever\b|\bwhat is wanted\b",
    re.I,
)


def offences() -> Iterator[str]:
    """What is wrong with which function or class, as `KIND MODULE.NAME`."""
    for module in modules().values():
        if not module.name.startswith("tactile_rt"):
            continue
        for node, owner in module.nodes:
            if not isinstance(node, (*FUNCTIONS, ast.ClassDef)):
                continue
            name = ".".join(filter(None, (module.name, owner and owner.name, node.name)))
            marks = {ast.unparse(one) for one in node.decorator_list}
            verb = isinstance(node, FUNCTIONS) and not marks & {"property", "cached_property"}
            if verb and PARTICIPLE.fullmatch(node.name):
                yield f"participle {name}"
            first = re.split(r"\.\s|\n\n", ast.get_docstring(node) or "")[0]
            if verb and RIDDLE.match(first):
                yield f"riddle {name}"
            if len(first.split()) > WORDS:
                yield f"long {name}"
            if UNCLEAR.search(first):
                yield f"unclear {name}"


def test_names_and_first_lines_are_plain() -> None:
    assert sorted(offences()) == [], "see CONTRIBUTING, Names and sentences"
