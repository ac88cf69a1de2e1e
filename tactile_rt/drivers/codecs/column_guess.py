"""Guesses of the columns of a table or of a board's lines, for users to correct.

Names reveal most: ``Fx [N]``, ``wrench.force.x``, ``p0_x``, ``timestamp_ms``. A column without a
name is classified by its numbers: steps of one are a count, rising numbers a time, all others
measurements. Units are never guessed: a number without a stated unit gets the unit 1.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codecs.ascii_mapping import UNITS
from tactile_rt.drivers.codecs.ascii_text import fields, in_seconds, number

LOOKED_AT: Final = 400  # lines
LEAST: Final = 5
MOSTLY: Final = 0.8  # least share of alike lines, and of cells with numbers
PER_SECOND: Final = (1, 1e3, 1e6, 1e9)  # s, ms, us, ns in a second; 2001 to 2065 are 1e9 to 3e9 s
FASTEST_HZ: Final = 50_000  # highest rate of tactile readings
DAYS: Final = (25_569, 80_000)  # of a spreadsheet: 1970 to 2119
SELDOM: Final = 50  # least number of rows between wraps or resets of a counter
Rows = Sequence[Sequence[float | None]]

_UNITS_OF_TIME: Final = {  # by their names, with the word for the column
    unit: word
    for word, units in (
        ("time:s", "s sec secs second seconds"), ("time:ms", "ms msec msecs"),
        ("time:us", "us \u00b5s usec usecs"), ("time:ns", "ns nsec nsecs"),
        ("time*60:s", "min mins minute minutes"), ("time*3600:s", "h hr hrs hour hours"),
    )
    for unit in units.split()
}  # fmt: skip
_TIME: Final = re.compile(
    r"s|ms|us|µs|ns|(?:%|.*[._ ])?"
    r"(?:time|timestamp|stamp|t|secs?|nsecs?|date|datetime|millis|micros|clock|elapsed|x_value"
    r"|(?:uhr)?zeit|datum)"
    rf"(?:s|sec|ms|us|µs|ns|nsec|[\W_]+(?:{'|'.join(_UNITS_OF_TIME)}))?", re.IGNORECASE,
)  # fmt: skip
_COUNT: Final = re.compile(
    r"(?:.*[._ ])?(?:seq|count|counter|samples?|frame|frame_?id|index|idx|n|no|id|packet|#)"
    r"|column\.\d+|unnamed.*",
    re.IGNORECASE,
)
_TIME_UNIT: Final = re.compile(rf"(?:^|[\W_]|millis|micros)({'|'.join(_UNITS_OF_TIME)})\W*$")
_IN_SECONDS: Final = re.compile(r"[\[(](?:s|sec|ms|us|\u00b5s|ns)[\])]")
_BRACKET: Final = re.compile(r"[\[(]([^\])]*)[\])]")
_OTHER_UNIT: Final = re.compile(r"\[[^\d\]]")  # an unknown unit in brackets
_TAIL_UNIT: Final = re.compile(
    r"_(mN|uN|kN|N|[mk]?Nm|Nmm|gf|kgf|[hkM]?Pa|mbar|[unm]?T|degC|C|K|rad|deg|mV|V|[cmu]m|pF)$"
)
_BEGIN, _END = r"(?:^|[\W_])", r"(?:$|[\W_]|(?=\d))"
_QUANTITY: Final = tuple(  # (name, channel, unit if the name implies it)
    (re.compile(pattern, re.IGNORECASE), channel, unit)
    for pattern, channel, unit in (
        (_BEGIN + r"(?:f|force|forces)[\W_]*([xyz])" + _END, "f{}", "N"),
        (_BEGIN + r"(?:t|m|torques?|moment|tau)[\W_]*([xyz])" + _END, "m{}", "Nm"),
        (_BEGIN + r"(?:b|mag|magnetic(?:_field)?|field)[\W_]*([xyz])" + _END, "b{}", ""),
        (_BEGIN + r"(?:temp|temperature)(?:$|[\W_])", "temperature", ""),
        (r"^(?:force|load|weight)(?=\d*$)", "force", ""),
        (r"(?<=[\W_])([xyz])(?:$|[\W_])", "{}", ""),
        (_BEGIN + r"(?:pressure|press)(?:$|[\W_])", "pressure", ""),
        (r"(?:^|(?<=\d))([xyz])$", "{}", ""),
        (r"^([xyz])(?=\d+$)", "{}", ""),
    )
)
_ALIASES: Final = {
    "n·m": "Nm", "n*m": "Nm", "n.m": "Nm", "n-m": "Nm", "nm": "Nm", "newton": "N", "newtons": "N",
    "°c": "degC", "c": "degC", "celsius": "degC", "µt": "uT", "μt": "uT", "utesla": "uT",
    "kg": "kgf", "volt": "V", "volts": "V", "m/s^2": "m/s2", "m/s²": "m/s2", "n": "N",
}  # fmt: skip
ALONE: Final = ("temperature", "pressure", "force")
_LABELLED: Final = re.compile(
    r"([A-Za-z_][\w ()\[\]/°%]*?(?:\s*[\[(][^\d\])=:][^\])=:]*[\])])?)\s*[:=\[]\s*([^\s,;|\]]+)"
    rf"(?: (?:{'|'.join(map(re.escape, [*UNITS, *_ALIASES, 'C']))})(?= ))?"
)
_WEIGHED: Final = re.compile(
    r"force|load|weight|mass|cell|grip|press|gewicht|kraft|last|poids|peso", re.IGNORECASE
)
_PLAIN: Final = re.compile(r"[^A-Za-z0-9_-]+")
_HAS_NAMES: Final = re.compile(r"=|:\s|[A-Za-z_)\]]:")


def guess_columns(
    names: Sequence[str], rows: Rows, dated: Collection[int] = ()
) -> tuple[list[str], bool]:
    """Guess each column's word, see `ascii_mapping`; return (words, whether any is a time).

    Args:
        rows: cells of some rows, None for a cell without a number.
    """
    width = len(names) or max(map(len, rows), default=0)
    series = [_read_column(rows, k) for k in range(width)]
    kinds: list[str] = ["" if s is not None else "-" for s in series]
    if (time := _place_time(names, series, dated)) is not None:
        kinds[time[0]] = time[1]
    if (count := _place_count(names, series, kinds)) is not None:
        kinds[count] = "count"
    for k, name in enumerate(names):  # ignore further times and counts
        if not kinds[k] and (_TIME.fullmatch(_strip_units(name)) or _is_count(name)):
            kinds[k] = "-"
    measured = [k for k, kind in enumerate(kinds) if not kind]
    plain = {k: f"T{i}.value" for i, k in enumerate(measured)}
    words = _name_words(names, measured) if names else plain
    return [words.get(k, kinds[k] or "-") for k in range(width)], time is not None


def list_unread_units(names: Sequence[str], words: Sequence[str]) -> list[str]:
    """List the units in brackets after names that could not be converted to SI."""
    alone = [
        n
        for n, w in zip(names, words, strict=False)
        if w.endswith(":1") or (w.startswith("time") and w != "time:iso" and not _find_time_word(n))
    ]
    units = [unit.strip() for name in alone for unit in _BRACKET.findall(name)]
    return [unit for unit in dict.fromkeys(units) if unit not in ("", "-", "1")]


def guess_line_columns(data: bytes) -> list[str] | None:
    """Guess the columns of a board's printed lines as words; return None if that fails."""
    first, *lines = data.decode("utf-8", "replace").replace("\r", "\n").split("\n")
    label = _LABELLED.match(first)
    if label and any(line.startswith(label[1]) for line in lines):  # the first line is whole
        lines.insert(0, first)
    lines = [x for x in lines[:-1] if re.search(r"\w", x)][:LOOKED_AT]
    text = "".join(lines).replace("\t", " ")
    odd = sum(not c.isprintable() or c == "\ufffd" for c in text)
    if len(lines) < LEAST or 20 * odd > len(text):
        return None
    return _guess_objects(lines) or _guess_places(lines) or _guess_labelled(lines)


def _guess_objects(lines: list[str]) -> list[str] | None:
    """Guess the columns of lines of JSON objects; return None if lines have another form."""
    objects = []
    for line in lines:
        with suppress(msgspec.DecodeError, UnicodeEncodeError):
            objects.append(msgspec.json.decode(line, type=dict[str, Any]))
    each = [dict(_list_numbers(decoded, "")) for decoded in objects]
    return _guess_named(each) if len(objects) >= MOSTLY * len(lines) else None


def _guess_labelled(lines: list[str]) -> list[str] | None:
    """Guess the columns of numbers that follow names, in one or more lines; else None."""
    each: list[dict[str, float]] = []
    used = 0
    for line in lines:
        labels = _LABELLED.finditer(in_seconds(line))
        pairs = [(label, v) for label in labels if (v := number(label[2])) is not None]
        found = {label[1].strip(): value for label, value in pairs}
        # a log in words has occasional numbers
        if not found or 2 * sum(len(label[0]) for label, _ in pairs) < len(line.strip()):
            continue
        used += 1
        if each and set(found).isdisjoint(each[-1]):
            each[-1] |= found
        else:
            each.append(found)
    return _guess_named(each) if used >= MOSTLY * len(lines) else None


def _guess_named(each: list[dict[str, float]]) -> list[str] | None:
    often = Counter(name for row in each for name in row)
    names = [name for name, n in often.items() if n >= MOSTLY * len(each)]
    if not names or len(each) < LEAST:
        return None
    rows = [[row.get(name) for name in names] for row in each]
    words, _ = guess_columns(names, rows)
    columns = [f"{name}={w}" for name, w in zip(names, words, strict=True) if w != "-"]
    whole = sum(all(cell is not None for cell in row) for row in rows)
    return columns if _has_measurement(words) and whole >= MOSTLY * len(each) else None


def _guess_places(lines: list[str]) -> list[str] | None:
    """Guess the columns of numbers between separators; return None for other lines."""
    cut = [fields(line) for line in lines]
    width, often = Counter(len(c) for c in cut).most_common(1)[0]
    if often < MOSTLY * len(lines):
        return None
    same = [(line, c) for line, c in zip(lines, cut, strict=True) if len(c) == width]
    rows = [[number(word) for word in c] for _, c in same]
    share = [sum(row[k] is not None for row in rows) / len(rows) for k in range(width)]
    numeric = [k for k in range(width) if share[k] >= MOSTLY]
    if 2 * len(numeric) < width or (2 * len(numeric) == width and width > 2):
        return None
    if sum(_HAS_NAMES.search(line) is not None for line, _ in same) > len(same) / 2:
        labelled = _guess_labelled(lines)  # names reveal more than places
        if labelled is not None and len(labelled) >= len(numeric) - 1:
            return labelled
    clocks = [(line, c) for line, c in same[:20] if in_seconds(line) != line]
    dated = {
        k
        for k in numeric
        if len(clocks) == len(same[:20]) and all(c[k] not in line for line, c in clocks)
    }
    words, _ = guess_columns((), rows, dated)
    heads = [c for c in cut if not any(number(word) is not None for word in c)]
    times = {k for c in heads for k, word in enumerate(c) if _TIME.fullmatch(word)}
    words = ["-" if k in times and "." in w else w for k, w in enumerate(words)]
    if not _has_measurement(words):
        return None
    varied = {tuple(row) for row in rows}
    return words if len(varied) > 1 or width > 1 else None


def _has_measurement(words: Iterable[str]) -> bool:
    return any("." in word for word in words if not word.startswith("time"))


def _list_numbers(value: Any, at: str) -> Iterable[tuple[str, float]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _list_numbers(item, f"{at}.{key}" if at else str(key))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _list_numbers(item, f"{at}.{k}")
    elif isinstance(value, int | float) and not isinstance(value, bool) and at:
        yield at, float(value)


# kinds of columns


def _read_column(rows: Rows, k: int) -> NDArray[np.float64] | None:
    """Return column k with NaN for cells without a number; None if too many."""
    cells = [row[k] if k < len(row) else None for row in rows]
    filled = sum(c is not None for c in cells)
    if not cells or filled < MOSTLY * len(cells):
        return None
    column = np.array([np.nan if c is None else c for c in cells], np.float64)
    return None if np.isnan(column).all() else column


def _strip_units(name: str) -> str:
    return _BRACKET.sub("", name).strip().strip('"')


def _is_count(name: str) -> bool:
    """Return whether a column's name means a counter; the N of ``Fx_N`` is a unit."""
    return _COUNT.fullmatch(_TAIL_UNIT.sub("", _strip_units(name))) is not None


def _place_time(
    names: Sequence[str], series: Sequence[NDArray[np.float64] | None], dated: Collection[int]
) -> tuple[int, str] | None:
    if dated:
        return min(dated), "time:iso"
    known = [k for k, name in enumerate(names) if _TIME.fullmatch(_strip_units(name))]
    known = known or [k for k, name in enumerate(names) if _IN_SECONDS.search(name)]
    for k in [*known, *(() if known else range(len(series)))]:
        v = series[k]
        if v is not None and k in known:  # skip the cells of footers and repeated headers
            v = v[np.isfinite(v)]
        if v is None or len(v) < 2 or not np.isfinite(v).all():
            continue
        steps = np.diff(v)
        rising = (steps >= 0).all() and v[-1] > v[0]
        if k in known:
            if rising or (steps >= 0).mean() > MOSTLY or (steps < 0).all():  # or newest first
                return k, _find_time_word(names[k]) or f"time:{_guess_time_unit(names[k], v)}"
        elif rising and (steps > 0).mean() > 0.5 and not names and not (steps == 1).all():
            # a measurement hardly ever rises as steadily, and none counts from 1970
            since_1970 = any(1e9 * unit <= v[0] <= v[-1] <= 3e9 * unit for unit in PER_SECOND)
            if np.std(steps) <= np.mean(steps) or since_1970:
                return k, f"time:{_guess_time_unit('', v)}"
    return None


def _find_time_word(name: str) -> str:
    """Return a time column's word from the unit in its name; empty without a unit."""
    found = _TIME_UNIT.search(name.strip().lower().replace("μ", "µ"))
    return _UNITS_OF_TIME[found[1]] if found else ""


def _guess_time_unit(name: str, v: NDArray[np.float64]) -> str:
    """Guess a time column's unit from its name, magnitude (since 1970) or steps."""
    for word, unit in (("millis", "ms"), ("micros", "us")):
        if word in name.lower():
            return unit
    size = float(np.nanmedian(np.abs(v)))
    for least, unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s")):
        if size > least:
            return unit
    steps = np.diff(v)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    if (v % 1 != 0).any():
        return "days" if DAYS[0] < size < DAYS[1] and step < 1 / FASTEST_HZ else "s"
    return "ms" if step < 200 else "us" if step < 500_000 else "ns"


def _place_count(
    names: Sequence[str], series: Sequence[NDArray[np.float64] | None], kinds: Sequence[str]
) -> int | None:
    for k, v in enumerate(series):
        if v is None or kinds[k] or (names and not _is_count(names[k])):
            continue
        if len(v) > 2 and np.isfinite(v).all() and (v % 1 == 0).all() and (v >= 0).all():
            steps = np.diff(v)  # a column that falls more often is a periodic reading
            if (steps == 1).mean() > MOSTLY and (steps < 0).sum() <= 1 + len(v) // SELDOM:
                return k
    return None


def _name_words(names: Sequence[str], measured: Sequence[int]) -> dict[int, str]:
    """Return words ELEMENT.CHANNEL:UNIT by column, for the elements that have all channels."""
    parsed = {k: _parse_name(names[k]) for k in measured}
    known = {k: p for k, p in parsed.items() if p[1]}
    loads = any(unit for _, _, unit in known.values())
    others = [unit for _, channel, unit in parsed.values() if not channel]
    if others and (len({*others}) > 1 or 2 * len(known) >= len(parsed)):
        # quantities of one element, such as force and temperature, each in its own unit
        named = {k: p[1] or p[0].lower() for k, p in parsed.items()}
        alone = all(p[0] == "S" and p[1] in ALONE for p in known.values())
        if alone and len(set(named.values())) == len(named):
            return {k: f"S.{channel}:{parsed[k][2] or '1'}" for k, channel in named.items()}
    if 2 * len(known) < len(parsed) and not loads:  # known channels are positions, not loads
        known = {k: (e, "value", u) for k, (e, c, u) in parsed.items() if not c}
    chosen = known or {k: (e, "value", u) for k, (e, _, u) in parsed.items()}
    groups: dict[str, dict[str, int]] = {}
    for k, (element, channel, _) in chosen.items():
        groups.setdefault(element, {}).setdefault(channel, k)
    shapes = Counter(frozenset(g) for g in groups.values())
    if not shapes:
        return {}
    best = max(shapes, key=lambda s: (len(s) * shapes[s], len(s)))
    whole = {element: g for element, g in groups.items() if frozenset(g) == best}
    each = {c: {chosen[g[c]][2] for g in whole.values()} for c in best}
    units = {c: "".join(found) if len(found) == 1 else "" for c, found in each.items()}
    return {k: f"{e}.{c}:{units[c] or '1'}" for e, g in whole.items() for c, k in g.items()}


def _parse_name(name: str) -> tuple[str, str, str]:
    """Split a name into its element, channel (empty if unknown) and unit."""
    unit = ""
    for inside in _BRACKET.findall(name):
        word = inside.strip()
        unit = word if word in UNITS else _ALIASES.get(word.lower(), "")
    bare = _strip_units(name)
    if not unit and (tail := _TAIL_UNIT.search(bare)):
        unit, bare = _ALIASES.get(tail[1].lower(), tail[1]), bare[: tail.start()]
    unit = "gf" if unit == "g" and _WEIGHED.search(bare) else unit  # gram-force, no acceleration
    for pattern, channel, usual in _QUANTITY:
        if (found := pattern.search(bare)) is None:
            continue
        axis = next((g for g in found.groups() if g), "").lower()
        if channel == "temperature" and unit not in ("K", "degC"):
            unit = ""  # F is farad, no unit of a temperature
        rest = bare[: found.start()] + " " + bare[found.end() :]
        rest = re.sub(r"(?i)(?:^|\W)(?:field|wrench|data|msg)(?=\W|$)", " ", rest)
        element = _PLAIN.sub("_", rest).strip("_-") or "S"
        element = f"S{element}" if element.isdecimal() else element
        return element, channel.format(axis), unit or usual
    unit = unit or ("1" if _OTHER_UNIT.search(name) else "")
    return _PLAIN.sub("_", bare).strip("_-") or "S", "", unit
