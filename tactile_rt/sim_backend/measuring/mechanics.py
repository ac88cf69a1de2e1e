"""Comparison of plucked whiskers' free swings with the prediction of their description.

A resonance determines only the ratio of stiffness to mass. Masses are easily known (length,
thickness, density), so the stiffness is fitted: Young's modulus, or the mount's stiffness if the
resonance depends on it more. Damping likewise.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from tactile_rt.core.errors import name_some
from tactile_rt.sim_backend.arrays.whiskers import OPTIONAL, PLAUSIBLE, SOFTEST_MOUNT, Whisker
from tactile_rt.sim_backend.measuring.findings import (
    MANY,
    MEDIAN,
    ArrayFinding,
    Figure,
    change,
    pool_figures,
)
from tactile_rt.sim_backend.measuring.ringing import HEARD, Ring
from tactile_rt.sim_backend.rods.rod import Rod, make_rod

LINKS = 20
FEWEST = 3  # plucks of a whisker
HZ_OFF, RATIO_OFF = 0.005, 0.03  # relative errors by higher modes and the size of the swing
APART = 1.1  # factor from most whiskers at which a whisker gets its own value
FURTHEST = 100.0  # largest factor by which a description may be wrong
COLUMNS = {field: column for column, field in OPTIONAL.items()}
TOO_FAST = "as described too fast for {:.4g} samples a second"
NOT_FREE = "no pluck that ends in a free swing"
UNITS = {
    "young_modulus": "Pa",
    "mount_stiffness": "N m/rad",
    "damping_ratio": "",
    "mount_damping": "N m s/rad",
}


def compare_whiskers(
    whiskers: Sequence[Whisker],
    rings: Mapping[str, Sequence[Ring]],
    rate_hz: float,
    tables: Mapping[str, tuple[int, Mapping[str, Any]]],
) -> list[ArrayFinding]:
    """Compare resonance and damping of every plucked whisker with its description.

    Args:
        tables: for each whisker, the number of its table in the array's file, and its content.
    """
    by_name = {w.name: w for w in whiskers}
    findings: list[ArrayFinding] = []
    found: dict[str, dict[str, Figure]] = {field: {} for field in UNITS}
    silent: dict[str, list[str]] = {}
    for whisker in whiskers:
        heard, of, rod = rings.get(whisker.name, ()), f"of {whisker.name}", _make_rod(whisker)
        if not heard:
            fast = rod.resonance_hz > HEARD * rate_hz
            why = TOO_FAST.format(rate_hz) if fast else NOT_FREE
            silent.setdefault(why, []).append(whisker.name)
            continue
        if note := _explain_missing(rod, heard, rate_hz):
            findings.append(ArrayFinding(f"resonance {of}", "Hz", rod.resonance_hz, None, note))
            continue
        hz = _combine_plucks([r.hz for r in heard], [r.hz_error for r in heard], HZ_OFF)
        ratio = _combine_plucks([r.ratio for r in heard], [r.ratio_error for r in heard], RATIO_OFF)
        findings.append(ArrayFinding(f"resonance {of}", "Hz", rod.resonance_hz, hz))
        findings.append(ArrayFinding(f"damping ratio {of}", "", rod.wanted_ratio, ratio))
        stiffness, damping = _choose_stiffness(whisker)
        solved = _solve_stiffness(whisker, stiffness, hz)
        if solved is None:
            note = "no value of it alone makes the whisker swing like this"
            now = getattr(whisker, stiffness)
            findings.append(ArrayFinding(f"{COLUMNS[stiffness]} {of}", "", now, None, note))
            continue
        found[stiffness][whisker.name] = solved
        stiff = _set_field(whisker, stiffness, solved.value)
        found[damping][whisker.name] = _solve_damping(stiff, damping, ratio)
    for why, names in silent.items():
        note = f"{why}: {name_some(names, MANY)}"
        findings.append(ArrayFinding("resonance", "Hz", None, None, note))
    for field, figures in found.items():
        findings += _report_field(field, figures, by_name, tables)
    return findings


def _explain_missing(rod: Rod, heard: Sequence[Ring], rate_hz: float) -> str:
    """Return the reason why a plucked whisker cannot be measured; empty if it can."""
    if rod.resonance_hz > HEARD * rate_hz:
        at = float(np.median([ring.hz for ring in heard]))
        return f"{TOO_FAST.format(rate_hz)}: what swings at {at:.3g} Hz may be an alias"
    return f"{len(heard)} plucks, and {FEWEST} are needed" if len(heard) < FEWEST else ""


def _set_field(whisker: Whisker, field: str, value: float) -> Whisker:
    changed: dict[str, Any] = {field: value}
    return replace(whisker, **changed)


def _make_rod(whisker: Whisker) -> Rod:
    return make_rod(whisker, LINKS, 1)


def _combine_plucks(values: Sequence[float], errors: Sequence[float], off: float) -> Figure:
    """Compute the median over several plucks; `off` is the relative error common to all."""
    scatter = max(float(np.std(values, ddof=1)), math.sqrt(np.mean(np.square(errors))))
    half = float(stats.t.ppf(0.975, len(values) - 1)) * MEDIAN * scatter / math.sqrt(len(values))
    value = float(np.median(values))
    half = math.hypot(half, off * value)
    return Figure(value, max(value - half, 0.0), value + half)


def _choose_stiffness(whisker: Whisker) -> tuple[str, str]:
    """Return the field names of the stiffness that most affects resonance, and its damping."""
    if whisker.mount_stiffness:
        stiffer = {
            field: _make_rod(_set_field(whisker, field, 1.1 * getattr(whisker, field))).resonance_hz
            for field in ("young_modulus", "mount_stiffness")
        }
        if stiffer["mount_stiffness"] > stiffer["young_modulus"]:
            return "mount_stiffness", "mount_damping"
    return "young_modulus", "damping_ratio"


def _solve_stiffness(whisker: Whisker, field: str, hz: Figure) -> Figure | None:
    """Solve for the stiffness that gives the measured frequency; None if no value does."""
    now = getattr(whisker, field)
    least, most = PLAUSIBLE.get(COLUMNS[field], (SOFTEST_MOUNT, math.inf))
    ends = (math.log(max(least / now, 1 / FURTHEST)), math.log(min(most / now, FURTHEST)))

    def off(log: float, target: float) -> float:
        return _make_rod(_set_field(whisker, field, now * math.exp(log))).resonance_hz - target

    targets = (hz.value, max(hz.low, hz.value / 2), hz.high)
    if not all(off(ends[0], target) < 0 < off(ends[1], target) for target in targets):
        return None
    return Figure(*(now * math.exp(brentq(off, *ends, args=(t,), xtol=1e-6)) for t in targets))


def _solve_damping(whisker: Whisker, field: str, target: Figure) -> Figure:
    """Solve for the damping that gives a whisker the measured ratio; the relation is linear."""
    unit = {"damping_ratio": 0.01, "mount_damping": 1e-9}[field]
    none, some = (_make_rod(_set_field(whisker, field, v)).wanted_ratio for v in (0.0, unit))
    value, low, high = (max((v - none) / (some - none), 0.0) * unit for v in target)
    return Figure(value, low, high)


def _report_field(
    field: str,
    figures: Mapping[str, Figure],
    whiskers: Mapping[str, Whisker],
    tables: Mapping[str, tuple[int, Mapping[str, Any]]],
) -> list[ArrayFinding]:
    """Report a fitted field: one value for [defaults], and the values of deviating whiskers."""
    column, unit = COLUMNS[field], UNITS[field]
    usual = [n for n in figures if column not in tables[n][1] and figures[n].low > 0]
    own = [n for n in figures if n not in usual]
    findings = []
    if usual:
        figure, strange = pool_figures([figures[n] for n in usual], APART)
        own += [usual[k] for k in strange]
        value, note = getattr(whiskers[usual[0]], field), f"of {len(usual) - len(strange)} whiskers"
        edits = change(("defaults", column), value, figure, f", {note}")
        findings.append(ArrayFinding(column, unit, value, figure, note, edits))
    by_table: dict[int, list[str]] = {}
    for name in own:
        by_table.setdefault(tables[name][0], []).append(name)
    for number, names in by_table.items():
        figure = figures[names[0]]
        # a whisker and its mirror image share a table
        if len(names) > 1 and all(figures[n].value for n in names):
            figure, _ = pool_figures([figures[n] for n in names], math.inf)
        value = getattr(whiskers[names[0]], field) if column in tables[names[0]][1] else None
        edits = change(("whisker", number, column), value, figure)
        what = f"{column} of {name_some(names, MANY)}"
        findings.append(ArrayFinding(what, unit, value, figure, "", edits))
    return findings
