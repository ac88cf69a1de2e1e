"""Contact finding on the test objects of a sweep set: the network beside the classical estimates.

Every stored sample after the lead counts, of every whisker. Distances are compared where a whisker
truly touches, whether or not that was found out. Intervals are 95 % bootstraps over objects; a
draw in which no object is touched tells nothing, and is not counted.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.contact_point import ESTIMATES
from tactile_rt.errors import ConfigError
from tactile_rt.evidence.records import Record
from tactile_rt.models.contact_regression import (
    FLOOR,
    ContactNetwork,
    load_contacts,
    predict_contacts,
    tared,
)
from tactile_rt.models.datasets import SweepSet
from tactile_rt.sweep_set import contacts_of

__all__ = [
    "LEVELS",
    "ContactSamples",
    "contact_records",
    "distance_estimates",
    "measure_contacts",
    "weighted_auroc",
    "weighted_quantile",
]

Floats = NDArray[np.float32]
Weights = NDArray[np.float64]

FELT_N = 30e-6  # of transverse force: three times the rated noise
AVERAGED = 5  # samples that the best classical estimate averages over under noise
RESAMPLES = 200
NO_INTERVAL = "no interval: touches of one object"
LEVELS = {"clean": 0.0, "noisy": 1.0}  # in units of the rated noise


def contact_records(checkpoint: Path, folder: Path) -> list[Record]:
    """Detection (AUROC, F1) and errors of distance (median, 95th percentile), clean and noisy.

    Args:
        checkpoint: file of `contact_regression.train_contacts`.
        folder: a sweep set with contacts; its validation split sets the thresholds of detection.

    Raises:
        ConfigError, RecordingError: they cannot be read, do not fit, or nothing is touched.
    """
    test, validation = SweepSet.read(folder, "test"), SweepSet.read(folder, "validation")
    network = load_contacts(checkpoint, test)
    records = []
    for name, level in LEVELS.items():
        split, tuning = (measure_contacts(network, data, level) for data in (test, validation))
        records += _detection(f"contact.{name}", split, tuning)
        records += _distances(f"contact.{name}", network, split, averaged=level > 0)
    return records


@dataclass(frozen=True)
class ContactSamples:
    """Samples after the lead, flattened over sweep and sample, of every whisker (n, element)."""

    loads: Floats  # (n, element, 6)
    smooth: Floats  # the same, averaged
    energy: Floats  # squared loads in units of the noise
    truth: Floats  # distance, m; NaN where nothing is touched
    force: Floats  # true transverse force, N
    touch: Floats  # the network's probability
    distance: Floats  # the network's, m
    objects: NDArray[np.int64]  # (n,) which of the split's objects


def measure_contacts(network: ContactNetwork, data: SweepSet, level: float) -> ContactSamples:
    """What there is to find, and what the network finds, at a level of the rated noise.

    Raises:
        ConfigError: the sweeps have no contacts, or touch nothing.
    """
    contacts = contacts_of(data.sweeps)
    felt, lead = tared(data, level, seed=7), data.manifest.lead
    touch, distance = predict_contacts(network, felt)
    scale = np.sqrt(np.square(np.array(FLOOR, dtype=np.float32)) + felt.sigma**2)
    if not np.isfinite(contacts[:, lead:]).any():
        raise ConfigError("nothing is touched in the set's test or validation sweeps: make more")

    def flat(values: Floats) -> Floats:
        return values[:, lead:].reshape(-1, *values.shape[2:])

    which = np.unique(data.sweeps.objects, return_inverse=True)[1]
    return ContactSamples(
        loads=flat(felt.loads),
        smooth=flat(_averaged(felt.loads)),
        energy=flat(np.square(felt.loads / scale[:, None]).sum(axis=-1)),
        truth=flat(contacts),
        force=flat(np.linalg.norm(data.sweeps.values[..., 1:3], axis=-1)),
        touch=flat(touch),
        distance=flat(distance),
        objects=np.repeat(which, felt.loads.shape[1] - lead),
    )


def _averaged(loads: Floats) -> Floats:
    """Each sample with those just before it."""
    sums = loads.cumsum(axis=1, dtype=np.float64)
    sums[:, AVERAGED:] = sums[:, AVERAGED:] - sums[:, :-AVERAGED]
    count = np.minimum(np.arange(1, sums.shape[1] + 1), AVERAGED)
    return (sums / count[:, None, None]).astype(np.float32)


def _detection(key: str, split: ContactSamples, tuning: ContactSamples) -> list[Record]:
    true, records = np.isfinite(split.truth), []
    said = f"{100 * true.mean():.1f} % of {true.size} samples of whiskers touch"
    of = np.repeat(split.objects, true.shape[1])
    for who, score, other in (
        ("network", split.touch, tuning.touch),
        ("loads", split.energy, tuning.energy),
    ):
        cuts = np.unique(np.quantile(other, np.linspace(0.5, 1.0, 101)))
        known = np.isfinite(tuning.truth)
        cut = max(cuts, key=lambda c: _f1((other >= c) & known, other >= c, known))
        found = score >= cut
        counts = [
            np.bincount(of, weights=x.ravel()) for x in (found & true, found, true)
        ]  # of each object
        draws = _draws(len(counts[0]))
        f1 = [_f1(*(w @ c for c in counts)) for w in draws]
        area = weighted_auroc(score.ravel(), true.ravel(), draws[:, of])
        for what, values, how in (
            ("auroc", area, said),
            ("f1", f1, f"{said}; threshold {cut:.3g} chosen on the validation split"),
        ):
            records.append(
                Record(f"{key}.{who}.{what}", float(values[0]), "", how=_interval(values, how))
            )
    return records


def distance_estimates(
    network: ContactNetwork, split: ContactSamples, averaged: bool
) -> dict[str, Weights]:
    """By whom, distances (touch,) of all true touches, m, in the order of `split.truth`.

    Args:
        network: beside which the classical estimates stand.
        split: its samples.
        averaged: add the best of them on averaged loads.
    """
    true = np.isfinite(split.truth)
    element = np.nonzero(true)[1]
    loads = split.loads[true].astype(np.float64)
    found: dict[str, Weights] = {"network": split.distance[true].astype(np.float64)}
    found |= {who: estimate(loads, element, network.shapes) for who, estimate in ESTIMATES.items()}
    if averaged:
        smooth = split.smooth[true].astype(np.float64)
        found["bent-averaged"] = ESTIMATES["bent"](smooth, element, network.shapes)
    return found


def _distances(
    key: str, network: ContactNetwork, split: ContactSamples, averaged: bool
) -> list[Record]:
    true = np.isfinite(split.truth)
    row, element = np.nonzero(true)
    length, wanted = network.shapes.length[element], split.truth[true].astype(np.float64)
    found = distance_estimates(network, split, averaged)
    found["middle"] = np.full(len(wanted), np.median(wanted / length)) * length
    records, felt = [], split.force[true] >= FELT_N
    for where, some in (("all", np.ones_like(felt)), ("felt", felt)):
        if not some.any():
            continue
        weights = _draws(int(split.objects.max()) + 1)[:, split.objects[row[some]]]
        for who, estimate in found.items():
            error = np.abs(estimate - wanted)[some]
            for what, share in (("median", 0.5), ("p95", 0.95)):
                mm = weighted_quantile(error * 1e3, weights, share)
                percent = weighted_quantile(100 * error / length[some], weights, share)
                how = _interval(mm, f"{mm[0]:.3g} mm", "; ") + f"; {some.sum()} touches"
                records.append(
                    Record(
                        f"{key}.{who}.{where}.{what}",
                        float(percent[0]),
                        "% of length",
                        how=_interval(percent, how),
                    )
                )
    return records


def _f1(
    both: NDArray[np.bool_] | float,
    found: NDArray[np.bool_] | float,
    true: NDArray[np.bool_] | float,
) -> float:
    return float(2 * np.sum(both) / (np.sum(found) + np.sum(true))) if np.any(true) else math.nan


def _draws(objects: int) -> Weights:
    """(1 + RESAMPLES, object) how often each is drawn; first every one once, as it is.

    Of a single object there is that alone: drawing it again tells nothing.
    """
    if objects == 1:
        return np.ones((1, 1))
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(objects, np.full(objects, 1 / objects), RESAMPLES)
    return np.concatenate([np.ones((1, objects)), drawn])


def _interval(values: Weights | list[float], how: str, between: str = "; ") -> str:
    drawn = np.array(values[1:])
    if np.isnan(drawn).all():
        return how if how.startswith(NO_INTERVAL) else f"{NO_INTERVAL}{between}{how}"
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return f"[{low:.4g}, {high:.4g}]{between}{how}"


def weighted_quantile(values: NDArray[np.float64], weights: Weights, share: float) -> Weights:
    """Quantiles (draw,) of values (n,) under each row of weights (draw, n); NaN where all are 0."""
    order = np.argsort(values)
    out = np.full(len(weights), np.nan)
    for i, w in enumerate(weights):
        if w.any():
            below = np.cumsum(w[order])
            out[i] = values[order[np.searchsorted(below, share * below[-1])]]
    return out


def weighted_auroc(score: Floats, true: NDArray[np.bool_], weights: Weights) -> Weights:
    """AUROC (draw,) of scores (n,) for true against not, under each row of weights (draw, n).

    NaN where the weights leave none of either.
    """
    _, rank = np.unique(score, return_inverse=True)
    out = np.full(len(weights), np.nan)
    for i, w in enumerate(weights):
        yes = np.bincount(rank, weights=w * true)
        no = np.bincount(rank, weights=w * ~true)
        if yes.any() and no.any():
            out[i] = yes @ (np.cumsum(no) - no / 2) / (yes.sum() * no.sum())
    return out
