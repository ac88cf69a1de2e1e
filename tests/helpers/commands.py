"""Every command of `tactile-rt`, walked from the application."""

import pkgutil
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import typer

from tactile_rt import cli
from tactile_rt.cli.app import app


def commands() -> dict[str, Any]:
    """Each command by its words, as ``model show``."""
    for module in pkgutil.iter_modules(cli.__path__, f"{cli.__name__}."):
        import_module(module.name)  # which adds its commands
    return dict(_below((), typer.main.get_command(app)))


def options_of(command: Any) -> dict[str, Any]:
    """The options of a command by their long name."""
    return {
        name: parameter
        for parameter in command.params
        for name in parameter.opts
        if name.startswith("--") and parameter.param_type_name == "option"
    }


def _below(words: tuple[str, ...], command: Any) -> Iterator[tuple[str, Any]]:
    for name, inner in getattr(command, "commands", {}).items():
        yield from _below((*words, name), inner)
    if not hasattr(command, "commands"):
        yield " ".join(words), command
