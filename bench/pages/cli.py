"""The page of all commands, docs/reference/cli.md, made of the commands themselves.

python -m bench.pages.cli
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from tactile_rt.cli import load_app

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "cli.md"
HEAD = """# Commands

<!-- written by `python -m bench.pages.cli`; do not edit -->

Every command of `tactile-rt`, in the order of `tactile-rt --help`. SOURCE and URL are
[the URL of a source](sources.md). A mistake in a command is one line on stderr and exit code 2
(3 of `align gate`).
"""
KINDS = {"str": "TEXT", "int": "INTEGER"}  # of values that an option takes


def make_page() -> str:
    """Return the whole page as Markdown."""
    lines, panel = [HEAD], ""
    program: Any = typer.main.get_command(load_app())
    for name, command in program.commands.items():
        if command.rich_help_panel != panel:
            panel = command.rich_help_panel
            lines.append(f"## {panel}\n")
        lines += _section(name, command)
        for inner, one in getattr(command, "commands", {}).items():
            lines += _section(f"{name} {inner}", one)
    return "\n".join(lines)


def example(command: Any) -> str:
    """Return the example of a command, without its heading."""
    return str(command.epilog)[str(command.epilog).index("tactile-rt ") :]


def _section(name: str, command: Any) -> Iterator[str]:
    """One command: what it does, its usage, its arguments and options, an example."""
    yield f"### {name}\n"
    yield f"{inspect.cleandoc(command.help)}\n"
    if hasattr(command, "commands"):
        return
    own = [p for p in command.params if p.name != "help"]
    arguments = [p for p in own if p.param_type_name == "argument"]
    options = [p for p in own if p.param_type_name == "option"]
    usage = ["tactile-rt", name, *map(_argument, arguments), *(["[OPTIONS]"] if options else [])]
    yield f"```text\n{' '.join(usage)}\n```\n"
    yield "".join(map(_line, (*arguments, *options)))
    yield f"```sh\n{example(command)}\n```\n"


def _argument(one: Any) -> str:
    """An argument as the usage shows it."""
    name = one.metavar or str(one.name).upper() + "..." * (one.nargs == -1)
    return name if one.required else f"[{name}]"


def _line(one: Any) -> str:
    """An argument or an option of the list, with its default."""
    if one.param_type_name == "argument":
        return f"- `{_argument(one)}`: {one.help}\n"
    kind = one.type.name.removesuffix(" range")
    value = "" if one.is_flag else f" {one.metavar or KINDS.get(kind, kind.upper())}"
    plain = one.default is False or one.default in (None, "") or "Default" in one.help
    default = "" if plain else f" Default: {one.default}."
    return f"- `{', '.join((*one.opts, *one.secondary_opts))}{value}`: {one.help}{default}\n"


if __name__ == "__main__":
    PAGE.write_text(make_page(), "utf-8")
