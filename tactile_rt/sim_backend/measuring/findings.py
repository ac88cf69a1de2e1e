"""What was measured, with the interval in which the truth lies in 19 cases of 20, beside what was
described."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

__all__ = [
    "MEDIAN",
    "SIGMAS",
    "TO_SIGMA",
    "ArrayFinding",
    "Edit",
    "Figure",
    "about",
    "change",
    "listed",
    "pooled",
    "spread_of",
]

TO_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute deviation
MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
SIGMAS = 1.96  # of an interval's half
EVEN = 1.2  # how much longer one half of an interval may be than the other to be told as one
MANY = 6  # whiskers that are named


class Figure(NamedTuple):
    """A measured quantity that is not negative.

    Attributes:
        value: The best estimate; 0 where only a limit is known.
        high: The upper end of the interval, or the limit.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if not self.value:
            return f"at most {self.high:.2g}" if self.high else "0"
        above = self.high - self.value
        if above > EVEN * (self.value - self.low):
            return f"{self.value:.3g} ({self.low:.2g} to {self.high:.2g})"
        percent = 100 * above / self.value
        if percent < 0.1:
            return f"{self.value:.4g}"
        return (
            f"{self.value:.3g} +- {percent:.0f} %"
            if percent >= 1
            else (f"{self.value:.4g} +- {percent:.1f} %")
        )


class Edit(NamedTuple):
    """A value that is to stand in an array's file.

    Attributes:
        path: The place of the value in the file: tables by name, one of several by its number
            from 0, and the key, e.g. ``("sensor", "channel", 0, "drift")``.
    """

    path: tuple[str | int, ...]
    value: float
    why: str


@dataclass(frozen=True)
class ArrayFinding:
    """One quantity of an array.

    Attributes:
        what: The name of the quantity, e.g. ``noise density of mz``.
        unit: The SI unit of the quantity; empty: it has none.
        described: The value that the array's file gives; None: it gives none.
        measured: The value that was measured; None: it could not be.
        note: The reason why it could not be measured, and whose value deviates.
        edits: The changes of the array's file that bring it to what was measured.
    """

    what: str
    unit: str
    described: float | None
    measured: Figure | None
    note: str = ""
    edits: tuple[Edit, ...] = ()

    def words(self) -> tuple[str, str, str, str, str]:
        """What it is, its unit, what is described, what was measured, and the ratio of the two."""
        described = "" if self.described is None else f"{self.described:.4g}"
        measured = "-" if self.measured is None else str(self.measured)
        told = self.described and self.measured and self.measured.value
        ratio = f"{told / self.described:.3g}" if told and self.described else ""
        return self.what, self.unit, described, measured, ratio


def about(value: float, error: float) -> Figure:
    """A figure with a relative error: half of its interval."""
    return Figure(value, value / (1 + error), value * (1 + error))


def pooled(figures: Sequence[Figure], apart: float) -> tuple[Figure, list[int]]:
    """One figure for several of one kind, and which of them are none of the kind.

    It is their median; its interval tells the uncertainty of each and how they scatter.

    Args:
        figures: at least one, none of them a mere limit.
        apart: the factor from which on one that is surely off the median counts as another kind.
    """
    logs = np.log([f.value for f in figures])
    errors = np.array([math.log(f.high / f.value) for f in figures])
    away = np.abs(logs - np.median(logs)) > np.maximum(math.log(apart), errors)
    alike = ~away if len(figures) > 2 else away | True
    centre = np.median(logs[alike])
    spread = TO_SIGMA * np.median(np.abs(logs[alike] - centre))
    each = max(math.sqrt(np.mean(errors[alike] ** 2)), SIGMAS * spread)
    half = each * (MEDIAN if alike.sum() > 2 else 1.0) / math.sqrt(alike.sum())
    return about(float(np.exp(centre)), math.expm1(half)), np.flatnonzero(~alike).tolist()


def spread_of(values: Sequence[float], known: float) -> Figure:
    """The standard deviation from which several values about 0 were drawn.

    Args:
        values: each of another whisker.
        known: the variance that something else adds to them.
    """
    total, n = float(np.square(values).sum()), len(values)
    least, most = (total / float(stats.chi2.ppf(p, n)) for p in (0.975, 0.025))
    if least <= known:
        return Figure(0.0, 0.0, math.sqrt(most))
    return Figure(*(math.sqrt(variance - known) for variance in (total / n, least, most)))


def change(
    path: tuple[str | int, ...], described: float | None, found: Figure, why: str = ""
) -> tuple[Edit, ...]:
    """What of a file's value is to change: nothing where it lies in the interval.

    A description beyond a limit is brought to the limit.
    """
    if described is not None and found.low <= described <= found.high:
        return ()
    return (Edit(path, float(f"{found.value or found.high:.4g}"), f"{found}{why}"),)


def listed(names: Sequence[str]) -> str:
    """The first of several names, and how many more there are."""
    more = f" and {len(names) - MANY} more" if len(names) > MANY else ""
    return ", ".join(names[:MANY]) + more
