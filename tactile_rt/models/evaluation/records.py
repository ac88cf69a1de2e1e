"""Benchmark results: one record per result, shown as a table or written as JSON."""

import json
import operator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from tactile_rt.models.evaluation.measures import Interval

COMPARISONS = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}


@dataclass(frozen=True)
class Record:
    """One benchmark result: a measured value, its unit, and the limit that it must meet.

    Attributes:
        bar: The limit that the value must meet, e.g. ``>= 91``; empty: the value is only reported.
        anchor: The context of the value or bar: an interval, a reference, or the bar's origin.
        how: The conditions of the measurement: sample, interval, machine.
    """

    name: str
    value: float
    unit: str
    bar: str = ""
    anchor: str = ""
    how: str = ""

    @property
    def met(self) -> bool | None:
        """True if the value meets its bar, False if not, None without a bar."""
        if not self.bar:
            return None
        sign, _, limit = self.bar.partition(" ")
        return bool(COMPARISONS[sign](self.value, float(limit)))


def record_share(
    name: str, estimate: "Interval", bar: str, how: str, unit: str = "%", beside: str = ""
) -> Record:
    """Return a `Record` of a model's share (0 to 1), in percent, with its interval."""
    interval = f"95 % interval {100 * estimate.low:.1f} to {100 * estimate.high:.1f}, by object"
    return Record(f"models.{name}", 100 * estimate.value, unit, bar, interval + beside, how)


def record_count(name: str, estimate: "Interval", how: str) -> Record:
    """Return a `Record` of a model's mean number, with its interval."""
    interval = f"95 % interval {estimate.low:.1f} to {estimate.high:.1f}, by object"
    return Record(f"models.{name}", estimate.value, "", "", interval, how)


def as_table(records: list[Record]) -> Table:
    """Format records as a table, with each measurement's conditions on a second line."""
    table = Table("figure", "value", "bar", "met", leading=1)
    table.columns[0].overflow = "fold"  # a name is one long word
    for column in table.columns[1:]:
        column.no_wrap = True
    marks = {True: "[green]yes[/]", False: "[bold red]MISSED[/]", None: ""}
    for r in records:
        how = "; ".join(part for part in (r.anchor, r.how) if part)
        figure = f"[bold]{escape(r.name)}[/]\n[dim]{escape(how)}[/]"
        table.add_row(figure, f"{r.value:.4g} {r.unit}", r.bar, marks[r.met])
    return table


def as_dicts(records: list[Record]) -> list[dict[str, Any]]:
    """Return records as JSON objects; "met" says whether the value meets its bar."""
    return [{**asdict(r), "met": r.met} for r in records]


def show(records: list[Record], console: Console) -> None:
    """Print records as a table on a console."""
    console.print(as_table(records))


def write(records: list[Record], path: Path) -> None:
    """Write records to a JSON file."""
    path.write_text(json.dumps(as_dicts(records), indent=1) + "\n")
