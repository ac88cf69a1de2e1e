"""The help of the program and of its groups: panels, whole sentences, examples that parse."""

import os
import re
import shlex

import pytest
import typer

from bench.pages.cli import example
from tactile_rt.cli import load_app
from tactile_rt.cli.panels import PANELS, WELCOME
from tests.helpers.commands import commands
from tests.helpers.processes import run_program
from tests.helpers.source_tree import ROOT

WIDEST = 72  # characters of a sentence
LARGEST = 8  # commands of a group without panels


def groups():
    """The program and its groups, by their names."""
    program = typer.main.get_command(load_app())
    inner = {n: c for n, c in program.commands.items() if hasattr(c, "commands")}
    return {"tactile-rt": program} | inner


def sentence(command):
    return " ".join(command.help.split("\n\n")[0].split())


def test_every_command_is_in_one_panel_in_its_order():
    assert PANELS.keys() <= groups().keys()
    for name, group in groups().items():
        names = [name for panel in PANELS.get(name, {}).values() for name in panel.split()]
        if name in PANELS or len(group.commands) > LARGEST:
            assert names == list(group.commands)
        shown = list(dict.fromkeys(c.rich_help_panel for c in group.commands.values()))
        assert shown == list(PANELS.get(name, ["Commands"]))


def test_every_command_begins_with_a_short_sentence():
    inner = [c for group in groups().values() for c in group.commands.values()]
    for command in inner:
        first = sentence(command)
        assert re.fullmatch(rf"[A-Z].{{10,{WIDEST - 2}}}\.", first), first
        assert not re.search(r"\. [A-Z]", first), first


@pytest.mark.parametrize("name", commands())
def test_the_example_of_a_command_is_parsed(name):
    command = commands()[name]
    said = example(command)
    words = name.split()
    assert shlex.split(said)[: len(words) + 1] == ["tactile-rt", *words]
    assert len(said) <= 76, "it is to fit on a line of 80 columns"
    command.make_context(name, shlex.split(said)[len(words) + 1 :])


def test_help_holds_no_markup_that_a_terminal_would_swallow():
    for name, command in commands().items():
        for text in (command.help, example(command), *(p.help or "" for p in command.params)):
            assert not re.search(r"\[[a-z/]", text), (name, text)


@pytest.mark.parametrize("columns", [40, 80, 100])
def test_no_sentence_is_cut(columns):
    program = "\n".join(
        f"try: get_command(load_app()).main({words}, prog_name='tactile-rt')\n"
        "except SystemExit: pass"
        for words in (["--help"], *([name, "--help"] for name in groups() if " " not in name))
    )
    program = f"from typer.main import get_command\nfrom tactile_rt.cli import load_app\n{program}"
    narrow = {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1"}
    done = run_program(program=program, env=narrow, cwd=ROOT)
    assert "…" not in done.stdout
    shown = re.sub(r"[│─╭╮╰╯\s]", "", done.stdout)
    for name, group in groups().items():
        for panel in PANELS.get(name, {}):
            assert panel.replace(" ", "") in shown
        for inner, command in group.commands.items():
            assert inner + sentence(command).replace(" ", "") in shown


def test_an_example_stands_on_a_line_of_its_own_in_a_narrow_pipe():
    done = run_program("emulate", "--help", env={**os.environ, "COLUMNS": "40"})
    *_, heading, last = done.stdout.rstrip().splitlines()
    assert heading.strip() == "Example:"
    assert last.strip() == example(commands()["emulate"])
    assert "\x1b" not in done.stdout


def test_the_program_alone_says_what_to_try(call):
    code, out, err = call()
    assert (code, out, err) == (0, f"{WELCOME}\n", "")
    assert max(map(len, out.splitlines())) <= 80
    tried = re.findall(r"^  tactile-rt (.+?)   ", out, re.M)
    assert len(tried) == 3
    for name in tried:
        assert name in commands()
    for extra in ("--help", "align and train"):
        assert extra in out
