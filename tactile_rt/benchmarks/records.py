"""Benchmark figures: one record per figure, one table, one JSON form."""

import json
import operator
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

__all__ = ["Record", "show", "write"]

COMPARISONS = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}


@dataclass(frozen=True)
class Record:
    """One measured figure.

    Attributes:
        name: what was measured, ``area.what``.
        value: the figure, in `unit`.
        unit: of the figure.
        bar: what it must reach, e.g. ``>= 91``; empty when it is only reported.
        anchor: what the bar or figure is compared to, or where the bar comes from.
        how: how it was measured: sample, interval, conditions.
    """

    name: str
    value: float
    unit: str
    bar: str = ""
    anchor: str = ""
    how: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the figure reaches its bar; None without one."""
        if not self.bar:
            return None
        sign, _, limit = self.bar.partition(" ")
        return bool(COMPARISONS[sign](self.value, float(limit)))


def show(records: list[Record], console: Console) -> None:
    """Print records as a table."""
    table = Table(show_lines=False)
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("bar", no_wrap=True)
    table.add_column("met", no_wrap=True)
    table.add_column("how", style="dim", overflow="fold")
    marks = {True: "[green]yes[/]", False: "[bold red]NO[/]", None: ""}
    for r in records:
        how = "; ".join(part for part in (r.anchor, r.how) if part)
        table.add_row(r.name, f"{r.value:.4g} {r.unit}", r.bar, marks[r.met], how)
    console.print(table)


def write(records: list[Record], path: Path) -> None:
    """Write records as JSON."""
    path.write_text(json.dumps([{**asdict(r), "met": r.met} for r in records], indent=1) + "\n")
