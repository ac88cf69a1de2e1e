"""The page of all commands is what they say themselves."""

import re

from bench.pages.cli import PAGE, example, make_page
from tests.helpers.commands import commands, options_of


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text("utf-8") == make_page(), "python -m bench.pages.cli writes it anew"


def test_every_command_is_there_with_its_options_and_example() -> None:
    sections = dict(
        re.findall(r"^### (.+?)\n(.*?)(?=^##|\Z)", PAGE.read_text("utf-8"), re.M | re.S)
    )
    for name, command in commands().items():
        assert f"tactile-rt {name}" in sections[name]
        assert example(command) in sections[name]
        for option in set(options_of(command)) - {"--help"}:
            assert f"- `{option}" in sections[name], (name, option)
