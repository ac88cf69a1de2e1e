"""Description of the columns that a board prints, in a file or words.

A column is written as one word:

    -                                 ignored
    count[:BITS]                      the sample's number, which wraps at 2^BITS (32)
    time[*SCALE]:s                    seconds, with decimals
    time:ms|us|ns[:BITS]              whole milli-, micro- or nanoseconds, wrapping at 2^BITS (32)
    time:days                         days since 30 December 1899, as spreadsheets have them
    time:iso                          2024-05-10 09:48:16.222, or a time of day, also with AM, PM
    time:mdy, time:dmy                05/10/2024 09:48:16, of May or of October
    ELEMENT.CHANNEL[*SCALE][:UNIT]    a measurement

or, if names stand before the numbers, as ``NAME=COLUMN``: ``X=M0.bx:uT``. Then numbers are found
by their names, in any order and in any number of lines, or in JSON: ``mag.x=M0.bx:uT`` is in an
object, ``Raw.6=M0.bx`` the seventh number after a name.

A word with a range stands for several columns (see `column_words`): ``T{0..15}.pressure``.

SCALE is the value, in UNIT, of a printed 1; samples are in SI. Without UNIT, SCALE is in SI.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, nearest, read_toml, refusal
from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codecs.column_words import expand_columns

VERSION: Final = 1
MOST_BITS: Final = 53  # of a counter: exact in a float64

_G: Final = 9.80665  # m/s^2
_SCALES: Final[dict[str, dict[str, float]]] = {  # SI unit: units on the wire, and SI units in each
    "N": {
        "N": 1.0, "mN": 1e-3, "uN": 1e-6, "kN": 1e3, "daN": 10.0, "gf": 1e-3 * _G, "kgf": _G,
        "lbf": 0.45359237 * _G,
    },
    "N m": {
        "N m": 1.0, "Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6, "kNm": 1e3, "Nmm": 1e-3, "Ncm": 1e-2,
        "kgfm": _G,
    },
    "Pa": {
        "Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "mbar": 1e2,
        "psi": 0.45359237 * _G / 0.0254**2,
    },
    "T": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9}, "K": {"K": 1.0, "degC": 1.0},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}, "V": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    "F": {"F": 1.0, "nF": 1e-9, "pF": 1e-12}, "m/s2": {"m/s2": 1.0, "g": _G}, "1": {"1": 1.0},
}  # fmt: skip
UNITS: Final = {  # unit on the wire: (SI unit, SI units in it, offset)
    unit: (si, scale, 273.15 if unit == "degC" else 0.0)
    for si, scales in _SCALES.items()
    for unit, scale in scales.items()
}
# SI units of channels, by their usual names
_KNOWN: Final = {
    **dict.fromkeys(("fx", "fy", "fz"), "N"), **dict.fromkeys(("mx", "my", "mz"), "N m"),
    **dict.fromkeys(("bx", "by", "bz"), "T"), "temperature": "K", "angle": "rad", "pressure": "Pa",
}  # fmt: skip

_MEASUREMENT: Final = re.compile(r"([^.*:\s]+)\.([^.*:\s]+)(?:\*([^:\s]+))?(?::(.+))?")
_SECONDS: Final = re.compile(r"time(?:\*([^:\s]+))?:s")
_WHOLE: Final = re.compile(r"(count|time:(?:ms|us|ns))(?::(\d+))?")
_WHISKER: Final = re.compile(r"([A-Z])(\d{1,2})")


class Element(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of one element.

    Attributes:
        grid: Place of the element on the grid, (row, column).
        position: Position of the element's base in the mount frame, m.
        orientation: Unit quaternion (w, x, y, z) that rotates the element's own frame into the
            mount frame.
    """

    grid: tuple[int, int] | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


class ArrayTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The array that a mapping file describes.

    Attributes:
        rate_hz: Rate at which the device sends samples, Hz.
        elements: Pose of each element, by name. Elements without a grid get their row and column
            from their names if all are named like whiskers, A0 to Z99; else they form one row.
    """

    version: int = VERSION
    name: str = "array"
    frame: str = "mount"
    rate_hz: float = 100.0
    elements: dict[str, Element] = {}


Table = TypeVar("Table", bound=ArrayTable)


class LineMapping(ArrayTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Mapping file of a board that prints lines, such as docs/codecs/ascii_line.toml.

    Attributes:
        columns: The columns of a line, in order or with their names; see the module's docstring.
        poll: Text to send for each sample; empty if the board prints by itself.
    """

    columns: tuple[str, ...]
    name: str = "ascii_line"
    start: str = ""
    stop: str = ""
    poll: str = ""


@dataclass(frozen=True)
class Column:
    """Column of printed numbers; its value in SI is number x scale + offset.

    Attributes:
        kind: Kind of the column: ``value``, ``count``, ``s`` (decimal time), ``iso`` (a date),
            ``ms``, ``us``, ``ns`` or ``-``.
        bits: Width of a counter or of an integer time, in bits.
        unit: SI unit of the measured value; of a date the order of its numbers, ``mdy`` or ``dmy``.
        label: Name before the number; empty if the number is found by its place.
    """

    kind: str
    scale: float = 1.0
    offset: float = 0.0
    bits: int = 32
    element: str = ""
    channel: str = ""
    unit: str = ""
    label: str = ""

    @classmethod
    def make_measured(cls, element: str, channel: str, unit: str, scale: float = 1.0) -> "Column":
        """Return a column of measurements, in which a printed 1 stands for `scale` units.

        The unit is one of `UNITS`; empty for the SI unit of a channel with a usual name.
        """
        si, factor, offset = UNITS[unit or _KNOWN.get(channel, "1")]
        return cls("value", scale * factor, offset, 0, element, channel, si)


def read_mapping(path: str, kind: type[Table]) -> Table:
    """Read a TOML mapping file into a `kind`; raise a ConfigError for another version."""
    nodes = read_toml(Path(path))
    mapping: Table = convert(nodes, kind)
    if mapping.version != VERSION:
        raise refusal(nodes, ["version"], f"this release reads {VERSION}, not {mapping.version}")
    return mapping


def parse_column(word: str, where: str) -> Column:
    """Return the column that a word describes.

    Raises:
        ConfigError: the word has another form, an unknown unit or an invalid scale.
    """
    label, named, plain = word.rpartition("=")
    if named:
        if not label.strip():
            raise ConfigError(f"{where}: {word!r} has no name before =")
        return replace(parse_column(plain.strip(), where), label=label.strip())
    if word == "-":
        return Column("-")
    if word in ("time:iso", "time:mdy", "time:dmy"):
        return Column("iso", unit=word[5:].removeprefix("iso"))
    if found := _WHOLE.fullmatch(word):
        bits = int(found[2] or 32)
        if not 1 <= bits <= MOST_BITS:
            raise ConfigError(f"{where}: a counter must have 1 to {MOST_BITS} bits, not {bits}")
        return Column(found[1].removeprefix("time:"), bits=bits)
    if word == "time:days":
        return Column("s", scale=86_400.0, offset=-86_400.0 * 25_569)  # days from 1899 to 1970
    if found := _SECONDS.fullmatch(word):
        return Column("s", scale=_parse_scale(found[1], where))
    found = _MEASUREMENT.fullmatch(word)
    if found is None:
        raise ConfigError(
            f"{where}: {word!r} is no column: write ELEMENT.CHANNEL*SCALE:UNIT (A0.fx*0.5:mN), "
            "count, time:ms, time:s, time:iso, or - for nothing"
        )
    element, channel, scale, unit = found.groups()
    if unit and unit not in UNITS:
        raise ConfigError(f"{where}: unknown unit {unit!r}; {nearest(unit, UNITS)}")
    return Column.make_measured(element, channel, unit or "", _parse_scale(scale, where))


def parse_columns(words: Iterable[str], where: str) -> tuple[Column, ...]:
    """Return the columns that words describe; a word with a range describes several."""
    each = [word for text in words for word in expand_columns(text, where)]
    return tuple(parse_column(word, f"{where}[{i}]") for i, word in enumerate(each))


def array_of(mapping: ArrayTable, columns: tuple[Column, ...], where: str) -> ArraySpec:
    """Return the array that columns describe; elements and channels in their first order.

    Raises:
        ConfigError: a column is missing, doubled or of another unit, or a pose has no element.
    """
    values = [c for c in columns if c.kind == "value"]
    if not values:
        raise ConfigError(f"{where}: no column measures anything, e.g. A0.fx")
    elements = tuple(dict.fromkeys(c.element for c in values))
    units: dict[str, str] = {}
    seen = set()
    for c in values:
        if (c.element, c.channel) in seen:
            raise ConfigError(f"{where}: {c.element}.{c.channel} appears twice")
        seen.add((c.element, c.channel))
        if units.setdefault(c.channel, c.unit) != c.unit:
            raise ConfigError(
                f"{where}: {c.element}.{c.channel} is in {c.unit}, but another {c.channel} in "
                f"{units[c.channel]}"
            )
    for element, channel in product(elements, units):
        if (element, channel) not in seen:
            raise ConfigError(
                f"{where}: no column {element}.{channel}; every element needs every channel"
            )
    for what, kinds in (("count", ["count"]), ("time", ["s", "iso", "ms", "us", "ns"])):
        if sum(c.kind in kinds for c in columns) > 1:
            raise ConfigError(f"{where}: {what} appears twice")
    for name in mapping.elements:
        if name not in elements:
            raise ConfigError(f"{where}: elements.{name} has no column")
    poses = [mapping.elements.get(e, Element()) for e in elements]
    try:
        return ArraySpec(
            name=mapping.name,
            elements=elements,
            grid=_make_grid(elements, poses),
            positions=tuple(p.position for p in poses),
            orientations=tuple(p.orientation for p in poses),
            channels=tuple(units),
            units=tuple(units.values()),
            rate_hz=mapping.rate_hz,
            frame=mapping.frame,
        )
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def order_columns(columns: Sequence[Column], spec: ArraySpec) -> list[int]:
    """Return the column index of each channel of each element, element by element."""
    at = {(c.element, c.channel): k for k, c in enumerate(columns)}
    return [at[e, c] for e in spec.elements for c in spec.channels]


def _make_grid(elements: tuple[str, ...], poses: list[Element]) -> tuple[tuple[int, int], ...]:
    names = [_WHISKER.fullmatch(e) for e in elements]
    cells = [
        p.grid or ((ord(n[1]) - ord("A"), int(n[2])) if n and all(names) else (0, i))
        for i, (p, n) in enumerate(zip(poses, names, strict=True))
    ]
    return tuple(cells)


def _parse_scale(text: str | None, where: str) -> float:
    try:
        scale = float(text or 1.0)
    except ValueError:
        scale = 0.0
    if not (np.isfinite(scale) and scale):
        raise ConfigError(f"{where}: scale must be a number other than 0, not {text!r}")
    return scale
