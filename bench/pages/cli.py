"""The page of all commands, docs/reference/cli.md, made of the commands themselves.

python -m bench.pages.cli
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from tactile_rt.cli import load_app

__all__ = ["PAGE", "example", "make_page"]

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
    lines = [HEAD]
    panel = ""
    for name, command in _commands(typer.main.get_command(load_app())):
        if " " not in name and command.rich_help_panel != panel:
            panel = command.rich_help_panel
            lines.append(f"## {panel}\n")
        lines += _section(name, command)
    return "\n".join(lines)


def example(command: Any) -> str:
    """Return the example of a command, without its heading."""
    return str(command.epilog)[str(command.epilog).index("tactile-rt ") :]


def _commands(group: Any, words: str = "") -> Iterator[tuple[str, Any]]:
    """Each visible command and group, with its words, as in the help."""
    for name, command in group.commands.items():
        if not command.hidden:
            yield f"{words}{name}", command
            if hasattr(command, "commands"):
                yield from _commands(command, f"{words}{name} ")


def _section(name: str, command: Any) -> Iterator[str]:
    """One command: what it does, its usage, its arguments and options, an example."""
    yield f"### {name}\n"
    yield f"{inspect.cleandoc(command.help)}\n"
    if hasattr(command, "commands"):
        return
    own = [p for p in command.params if p.name != "help" and not getattr(p, "hidden", False)]
    arguments = [p for p in own if p.param_type_name == "argument"]
    options = [p for p in own if p.param_type_name == "option"]
    usage = ["tactile-rt", name, *map(_argument, arguments), *(["[OPTIONS]"] if options else [])]
    yield f"```text\n{' '.join(usage)}\n```\n"
    yield "".join(f"- `{_argument(p)}`: {p.help}\n" for p in arguments) + "".join(
        f"- {_option(p)}: {p.help}{_default(p)}\n" for p in options
    )
    yield f"```sh\n{example(command)}\n```\n"


def _argument(one: Any) -> str:
    """An argument as the usage shows it."""
    name = one.metavar or str(one.name).upper() + "..." * (one.nargs == -1)
    return name if one.required else f"[{name}]"


def _option(one: Any) -> str:
    """An option and what it takes."""
    kind = one.type.name.removesuffix(" range")
    value = "" if one.is_flag else f" {one.metavar or KINDS.get(kind, kind.upper())}"
    return f"`{', '.join((*one.opts, *one.secondary_opts))}{value}`"


def _default(one: Any) -> str:
    known = one.default is None or one.default is False or one.default == ""
    return "" if known or "Default" in one.help else f" Default: {one.default}."


def main() -> None:
    PAGE.write_text(make_page(), "utf-8")


if __name__ == "__main__":
    main()
