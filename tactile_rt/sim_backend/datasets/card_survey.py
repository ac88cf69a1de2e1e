"""Counts and measurements of a sweep set: the numbers of its card.

One object is read at a time, so that the set may be larger than the memory. A set's separability is
checked as published: Chung et al. (2025) decode 2, 3 and 4 classes (cups, microwaves, chairs,
trains) from the raw loads by support vector machines. Here the machines are tested on new objects,
or they would only have to recognise sweeps of known objects.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.stream import STEP_MS, STEPS
from tactile_rt.core.stream.sensor_spec import ChannelLimits
from tactile_rt.sets.manifest import SweepManifest, has_object
from tactile_rt.sets.objects import read_object, read_skipped

TOUCH_N = 1e-6  # a whisker is touched when its load exceeds this, and twice the lead's largest
DECADES = (-7, 1)  # of the histogram of forces, N
BINS_A_DECADE = 5
PUBLISHED_CLIP = {"N": 1.0, "N m": 1e-2}  # Chung et al. (2025)
PENALTY = 10.0  # C of the support vector machine
PER_CLASS = 120  # sweeps of a class to train on, at most: enough to see that it can be learnt
# The published classes, each with the categories nearest to it, best first.
PUBLISHED = (
    ("cup", "mug"),
    ("microwave", "books", "house", "sofa"),
    ("chair",),
    ("train", "truck", "car", "plane"),
)

# Values (sweep, feature), names (sweep,) and a penalty -> a machine that classifies other values.
Fit = Callable[
    [NDArray[np.float32], NDArray[Any], float], Callable[[NDArray[np.float32]], NDArray[Any]]
]


@dataclass(frozen=True)
class Features:
    """Input features (sweep, feature) of some sweeps, and their categories (sweep,)."""

    values: NDArray[np.float32]
    categories: NDArray[np.str_]


@dataclass(frozen=True)
class Separability:
    """A classifier's accuracy on some classes, for objects that it was not trained on.

    Attributes:
        accuracy: The mean over classes of the share of correctly classified sweeps, 0 to 1.
    """

    classes: tuple[str, ...]
    accuracy: float


@dataclass
class Card:
    """The counts and measurements that a sweep set's card shows.

    Attributes:
        sweeps, objects: The counts of sweeps and of objects, by split and category.
        unit: The unit of the channels that count as load: N if force is measured, else the unit of
            the first channel.
        load_edges: The (bin + 1,) edges of the histogram of the largest load of every touched
            whisker in every sweep.
        load_counts: The (bin,) numbers of touched whiskers over all sweeps, in each bin of it.
        coverage: The share of the sweeps in which each whisker is touched, 0 to 1, by its name.
        whiskers_touched: The mean number of touched whiskers, over sweeps that touch any.
    """

    sweeps: dict[str, dict[str, int]] = field(default_factory=dict)
    objects: dict[str, dict[str, int]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    unit: str = "N"
    clip: float = 0.0
    load_edges: list[float] = field(default_factory=list)
    load_counts: list[int] = field(default_factory=list)
    median_load: float = 0.0
    coverage: dict[str, float] = field(default_factory=dict)
    whiskers_touched: float = 0.0
    samples: int = 0
    clips: dict[str, int] = field(default_factory=dict)
    largest: tuple[float, str] = (0.0, "")
    without_touch: int = 0
    misses: int = 0
    unstable: int = 0
    not_finite: int = 0
    separability: list[Separability] = field(default_factory=list)


@dataclass
class _Findings:
    """Measurements collected object by object, which `_summarise` converts into the card."""

    # (element,) of every sweep: the largest load; 0 for an untouched whisker.
    peaks: list[NDArray[np.float32]] = field(default_factory=list)
    parameters: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    # Of the sweeps with a touch, in the splits that a machine is trained and tested on.
    features: dict[str, list[NDArray[np.float32]]] = field(
        default_factory=lambda: {"train": [], "test": []}
    )
    categories: dict[str, list[str]] = field(default_factory=lambda: {"train": [], "test": []})
    examples: dict[str, NDArray[np.float32]] = field(default_factory=dict)  # (sample, element)


def survey(folder: Path, fit: Fit) -> tuple[Card, dict[str, NDArray[np.float32]]]:
    """Measure the objects that exist in a sweep set's folder, and return its card.

    Returns:
        The card, and for each category the load (sample, element) of a sweep with a touch.
    """
    manifest = SweepManifest.read(folder)
    units = manifest.spec.units
    unit = "N" if "N" in units else units[0]
    clip = float(manifest.limits.clip[units.index(unit)])
    card, found = Card(skipped=read_skipped(folder), unit=unit, clip=clip), _Findings()
    for split, names in manifest.split.items():
        for name in names:
            if has_object(folder, name):
                _add_object(card, found, manifest, folder, split, name)
    if not found.peaks:
        raise RecordingError(f"{folder} has no sweeps yet: there is nothing to write a card of")
    _summarise(card, found, manifest)
    train, test = (
        Features(np.array(found.features[s]), np.array(found.categories[s]))
        for s in ("train", "test")
    )
    if len(train.categories) and len(test.categories):
        card.separability = check_separability(train, test, fit)
    return card, found.examples


def _add_object(
    card: Card, found: _Findings, manifest: SweepManifest, folder: Path, split: str, name: str
) -> None:
    values, parameters = read_object(folder, name)
    category, units, limits = manifest.category(name), manifest.spec.units, manifest.limits
    own = {unit: float(limits.clip[units.index(unit)]) for unit in dict.fromkeys(units)}
    loads = _find_channels(units, card.unit)
    least = TOUCH_N if card.unit == "N" else float(limits.floor[loads].min())
    for counts, n in ((card.objects, 1), (card.sweeps, len(values))):
        counts.setdefault(split, {}).setdefault(category, 0)
        counts[split][category] += n
    for key, drawn in parameters.items():
        if drawn.dtype.kind == "U":  # a name, which has no range
            continue
        found.parameters.setdefault(key, []).append(drawn)
    card.misses += int((parameters.get("touches", np.array(True)) == 0).sum())
    card.unstable += int(parameters.get("unstable", np.array(False)).sum())
    card.samples += values.size
    for label, clips in (("published", PUBLISHED_CLIP), ("networks", own)):
        for unit in dict.fromkeys(u for u in units if u in clips):
            beyond = np.abs(values[..., _find_channels(units, unit)]) > clips[unit]
            key = f"{clips[unit]:.6g} {unit} ({label})"
            card.clips[key] = card.clips.get(key, 0) + int(beyond.sum())
    for index, sweep in enumerate(values):
        if not np.isfinite(sweep).all():
            card.not_finite += 1
            continue
        if manifest.lead:
            sweep = sweep - sweep[: manifest.lead].mean(axis=0)  # a magnet has a field at rest
        load = np.linalg.norm(sweep[..., loads], axis=2)  # (sample, element)
        noise = load[: manifest.lead].max(initial=0.0)
        threshold = max(least, float(2 * noise))
        peak = load.max(axis=0)
        found.peaks.append(np.where(peak > threshold, peak, np.float32(0)))
        if peak.max() > card.largest[0]:
            card.largest = (float(peak.max()), f"{name}, sweep {index}")
        if not (peak > threshold).any():
            card.without_touch += 1
            continue
        found.examples.setdefault(category, load)
        if split in found.features:
            start = int(np.argmax((load > threshold).any(axis=1)))
            period_ms = manifest.period_ns * 1e-6
            found.features[split].append(window_features(sweep, start, period_ms, limits))
            found.categories[split].append(category)


def _find_channels(units: tuple[str, ...], unit: str) -> list[int]:
    return [i for i, u in enumerate(units) if u == unit]


def _summarise(card: Card, found: _Findings, manifest: SweepManifest) -> None:
    for key, drawn in found.parameters.items():
        values = np.concatenate(drawn)
        least, mean, greatest = values.min(), values.mean(), values.max()
        card.parameters[key] = (float(least), float(mean), float(greatest))
    peaks = np.stack(found.peaks)  # (sweep, element), 0 where untouched
    touched = peaks > 0
    low, high = DECADES
    if card.unit != "N":
        floor = manifest.limits.floor[manifest.spec.units.index(card.unit)]
        low, high = math.floor(math.log10(floor)), math.ceil(math.log10(card.clip))
    edges = np.logspace(low, high, (high - low) * BINS_A_DECADE + 1)
    card.load_edges = edges.tolist()
    card.load_counts = np.histogram(peaks[touched], edges)[0].tolist()
    card.median_load = float(np.median(peaks[touched])) if touched.any() else 0.0
    card.coverage = dict(zip(manifest.spec.elements, touched.mean(axis=0).tolist(), strict=True))
    touching = touched.any(axis=1)
    card.whiskers_touched = float(touched[touching].sum(axis=1).mean()) if touching.any() else 0.0


def window_features(
    values: NDArray[np.float32], start: int, period_ms: float, limits: ChannelLimits
) -> NDArray[np.float32]:
    """Compute a sweep's input features (22 * element * channel,): log-scaled means of 22 steps.

    Args:
        values: (sample, element, channel) SI.
        start: index of the first sample in contact.
    """
    edges = start + np.arange(STEPS + 1) * STEP_MS / period_ms
    edges = np.minimum(edges.round().astype(int), len(values) - 1)
    steps = np.stack([values[a : max(b, a + 1)].mean(axis=0) for a, b in pairwise(edges)])
    steps = np.clip(steps, -limits.clip, limits.clip)
    features = np.sign(steps) * np.log1p(np.abs(steps) / limits.noise)
    flat: NDArray[np.float32] = features.astype(np.float32).ravel()
    return flat


def check_separability(train: Features, test: Features, fit: Fit) -> list[Separability]:
    """Measure accuracy on the 2, 3 and 4 categories nearest to the published classes.

    Args:
        train, test: features of sweeps; no object is in both.
    """
    known = sorted(set(train.categories) & set(test.categories))
    nearest = [next((c for c in names if c in known), None) for names in PUBLISHED]
    pool = dict.fromkeys([*filter(None, nearest), *known])
    chosen = [tuple(pool)[:n] for n in (2, 3, 4) if n <= len(pool)]
    return [Separability(classes, _accuracy(train, test, classes, fit)) for classes in chosen]


def _accuracy(train: Features, test: Features, classes: tuple[str, ...], fit: Fit) -> float:
    """Return the mean over classes of the share of correctly classified test sweeps."""
    chosen = np.concatenate([np.flatnonzero(train.categories == c)[:PER_CLASS] for c in classes])
    predict = fit(train.values[chosen], train.categories[chosen], PENALTY)
    right = [(predict(test.values[test.categories == c]) == c).mean() for c in classes]
    return float(np.mean(right))
