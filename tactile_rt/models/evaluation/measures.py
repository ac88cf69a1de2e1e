"""Performance measures of a classifier on unseen objects, with intervals bootstrapped by object.

The sweeps may be disturbed first (`disturbances`). Sweeps of one object are not independent, so
intervals resample objects, not sweeps.

Predictions are posteriors (sweep, step, class). A sweep without a detected contact has no
decision, and counts as wrong in accuracies.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.classifier import fuse
from tactile_rt.classifier.model_card import ModelCard, kind_columns
from tactile_rt.classifier.model_file import file_outputs
from tactile_rt.models.datasets import SweepSet, windows
from tactile_rt.models.disturbances import CLEAN, Disturbance

if TYPE_CHECKING:
    from tactile_rt.models.ead import TactileClassifier

Floats = NDArray[np.float32]
Labels = NDArray[np.int64]
Names = NDArray[np.str_]
# samples (batch, step, sub-step, element, channel), offset and sigma (batch, element, channel), SI
# -> logits (batch, step, class)
Step = Callable[[Floats, Floats, Floats], Floats]
LEVELS = (2.5, 97.5)  # percentiles of the 95 % interval


@dataclass(frozen=True)
class CutWindows:
    """Windows cut from a batch of sweeps, with the detector's baseline at their onsets.

    Attributes:
        samples: (sweep, step, sub-step, element, channel) The samples of the windows, SI.
        offset, sigma: (sweep, element, channel) The mean and noise at rest, SI.
        detected: (sweep,) True if a contact was detected; otherwise the samples are meaningless.
    """

    samples: Floats
    offset: Floats
    sigma: Floats
    detected: NDArray[np.bool_]


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.value:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def predict(
    data: SweepSet,
    run: Step,
    noise_level: float = 0.0,
    seed: int = 0,
    disturbance: Disturbance = CLEAN,
) -> Floats:
    """Compute the posteriors of every sweep at every step from its detected onset.

    Args:
        run: function of (samples, offset, sigma) that returns logits (batch, step, class).
        noise_level: white sensor noise added to every stored sample, in units of the rated noise;
            if not 0, it replaces the noise of `disturbance`.

    Returns:
        Posteriors (sweep, step, class); NaN where no contact was detected.
    """
    if noise_level:
        disturbance = replace(disturbance, noise=noise_level)
    return posteriors(cut_windows(data, seed, disturbance=disturbance), run)


def posteriors(cut: Iterable[CutWindows], run: Step) -> Floats:
    """Compute posteriors (sweep, step, class) of windows; NaN without contact or on overflow."""
    logits, found = run_over(cut, run)
    with np.errstate(invalid="ignore"):
        posterior = softmax(logits)
    posterior[~found] = np.nan
    return posterior


def cut_windows(
    data: SweepSet, seed: int = 0, batch: int = 64, disturbance: Disturbance = CLEAN
) -> Iterator[CutWindows]:
    """Disturb all sweeps and yield their windows from the detected onset, `batch` at a time."""
    rng = np.random.default_rng(seed)
    for i in range(0, len(data.sweeps), batch):
        part = data[i : i + batch]
        values = disturbance.disturb_samples(part.sweeps.values, part, rng)
        found = part.onsets(values)
        cut = disturbance.disturb_windows(windows(values, found.start, data.timing), data, rng)
        yield CutWindows(cut, found.offset, found.sigma, found.start >= 0)


def run_over(cut: Iterable[CutWindows], run: Step) -> tuple[Floats, NDArray[np.bool_]]:
    """Run a function on windows; return its outputs and a mask (sweep,) of detected contacts.

    Args:
        run: function of (samples, offset, sigma) of windows, as for `predict`, with any output.
    """
    parts = [(run(one.samples, one.offset, one.sigma), one.detected) for one in cut]
    out, detected = zip(*parts, strict=True)
    return np.concatenate(out), np.concatenate(detected)


def at_temperature(posteriors: Floats, temperature: float) -> Floats:
    """Rescale posteriors (..., class) by dividing their logits by a temperature."""
    with np.errstate(divide="ignore"):
        logits = np.log(posteriors) / np.float32(temperature)
    return softmax(logits)


def softmax(logits: NDArray[Any]) -> Floats:
    """Return the posteriors (..., class) of logits (..., class)."""
    raised = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(raised / raised.sum(axis=-1, keepdims=True))


def among(posteriors: Floats, classes: int) -> Floats:
    """Condition posteriors (..., label) on the first `classes` labels; return (..., class)."""
    own = posteriors[..., :classes]
    return np.asarray(own / np.maximum(own.sum(axis=-1, keepdims=True), 1e-30))


def split_by_class(
    logits: Floats,
    found: NDArray[np.bool_],
    numbers: Labels,
    kinds: Mapping[str, Sequence[str]],
) -> Iterator[tuple[str, Labels, Floats, Labels]]:
    """Split sweeps by their true class and compute posteriors of the kinds within that class.

    Args:
        logits: (sweep, step, name) logits of the kinds of all classes.
        found: (sweep,) True if a contact was detected.
        numbers: (sweep,) number of the true kind, as from `SweepSet.kinds`.
        kinds: the kinds of each class.

    Yields:
        The class, the indices of its sweeps, their posteriors (sweep, step, kind), NaN where no
        contact was detected, and their true kinds (sweep,), numbered within the class.
    """
    for name, columns in kind_columns(kinds).items():
        at = np.flatnonzero((numbers >= columns.start) & (numbers < columns.stop))
        with np.errstate(invalid="ignore"):
            own = softmax(logits[at][..., columns])
        own[~found[at]] = np.nan
        yield name, at, own, numbers[at] - columns.start


def hits(posteriors: Floats, labels: Labels, top: int = 1) -> NDArray[np.bool_]:
    """Return a mask (sweep,) of labels among the `top` most probable classes; NaN: False."""
    decided = ~np.isnan(posteriors).any(axis=1)
    order = np.argsort(-np.nan_to_num(posteriors), axis=1, kind="stable")[:, :top]
    return np.asarray(decided & (order == labels[:, None]).any(axis=1))


def auroc(known: Floats, unknown: Floats) -> float:
    """Return the area under the ROC curve of scores for known against unknown objects.

    Args:
        known, unknown: (sweep,) scores; NaN, where no contact was detected, is the lowest.

    Returns:
        The probability that a known sweep has the higher score; NaN if there is only one group.
    """
    if not len(known) or not len(unknown):
        return float("nan")
    low, high = np.nan_to_num(unknown, nan=-np.inf), np.nan_to_num(known, nan=-np.inf)
    order = np.sort(low)
    below, ties = np.searchsorted(order, high), np.searchsorted(order, high, side="right")
    return float((below + ties).mean() / (2 * len(low)))


def open_set(known: Floats, objects: Names, unknown: Floats, others: Names) -> Interval:
    """Measure the open-set AUROC, with interval, from scores (sweep,) and object names (sweep,)."""
    scores = np.concatenate([known, unknown])

    def area(at: Labels) -> float:
        mine = at < len(known)
        return auroc(scores[at[mine]], scores[at[~mine]])

    return bootstrap(area, np.concatenate([objects, others]))


def deciding_step(posteriors: Floats, labels: Labels) -> NDArray[np.int64]:
    """Return the step (sweep,) from which the decision stays right until the window's end.

    Steps count from 1; 0 if the last decision is wrong. Posteriors are (sweep, step, class).
    """
    steps = posteriors.shape[1]
    right = np.stack([hits(posteriors[:, t], labels) for t in range(steps)], axis=1)
    kept = np.logical_and.accumulate(right[:, ::-1], axis=1).sum(axis=1)  # final right steps
    return np.where(kept > 0, steps - kept + 1, 0).astype(np.int64)


def fused_accuracy(posteriors: Floats, labels: Labels, objects: Names, sweeps: int = 2) -> Interval:
    """Measure the accuracy of posteriors (sweep, class) fused over successive sweeps of an object.

    A sweep without contact contributes nothing; a group of only such sweeps counts as wrong.
    """
    correct, of = [], []
    for name in np.unique(objects):
        mine = np.flatnonzero(objects == name)
        for i in range(0, len(mine) - sweeps + 1, sweeps):
            group = [posteriors[k] for k in mine[i : i + sweeps] if not np.isnan(posteriors[k, 0])]
            of.append(name)
            correct.append(bool(group) and int(fuse(group).argmax()) == labels[mine[0]])
    return accuracy(np.array(correct), np.array(of))


def confusion(posteriors: Floats, labels: Labels, classes: int) -> NDArray[np.int64]:
    """Return the confusion matrix (true class, decided class) of sweeps with a decision."""
    decided = ~np.isnan(posteriors).any(axis=1)
    table = np.zeros((classes, classes), dtype=np.int64)
    np.add.at(table, (labels[decided], posteriors[decided].argmax(axis=1)), 1)
    return table


def expected_calibration_error(posteriors: Floats, labels: Labels, bins: int = 15) -> float:
    """Return the ECE (Guo et al. 2017): mean gap of confidence and accuracy in equal bins."""
    decided = ~np.isnan(posteriors).any(axis=1)
    confidence = posteriors[decided].max(axis=1)
    right = posteriors[decided].argmax(axis=1) == labels[decided]
    which = np.minimum((confidence * bins).astype(int), bins - 1)
    gaps = [
        abs(confidence[which == b].mean() - right[which == b].mean()) * (which == b).sum()
        for b in np.unique(which)
    ]
    return float(sum(gaps) / max(len(right), 1))


def accuracy(correct: NDArray[Any], objects: Names, resamples: int = 2000) -> Interval:
    """Return the mean over sweeps with a percentile bootstrap interval over objects.

    Args:
        correct: (sweep,) True if the decision is right; or the difference of two such arrays, to
            compare two conditions on the same sweeps; or (seed, sweep), and then seeds are
            resampled too.
        objects: (sweep,) object of each sweep.
    """
    runs = np.atleast_2d(correct).astype(np.float64)
    _, which = np.unique(objects, return_inverse=True)
    count = np.bincount(which)
    right = np.stack([np.bincount(which, weights=run) for run in runs])  # (seed, object)
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(count), (resamples, len(count)))
    seeds = rng.integers(0, len(right), (resamples, len(right)))
    total = np.zeros(resamples)
    for seed in seeds.T:
        total += right[seed[:, None], drawn].sum(axis=1)
    means = total / len(right) / count[drawn].sum(axis=1)
    low, high = np.percentile(means, LEVELS)
    return Interval(float(runs.mean()), float(low), float(high))


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], float], objects: Names, resamples: int = 300
) -> Interval:
    """Return a statistic of all sweeps with a percentile bootstrap interval over objects.

    Args:
        statistic: function of sweep indices (k,), which may repeat; returns NaN where it is
            undefined, for example for a resample of only known objects.
        objects: (sweep,) object of each sweep.
    """
    _, which = np.unique(objects, return_inverse=True)
    of = np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1])
    rng = np.random.default_rng(0)
    values = [
        statistic(np.concatenate([of[k] for k in rng.integers(0, len(of), len(of))]))
        for _ in range(resamples)
    ]
    low, high = np.nanpercentile(values, LEVELS)
    return Interval(statistic(np.arange(len(objects))), float(low), float(high))


def macro_accuracy(correct: NDArray[np.bool_], labels: Labels, objects: Names) -> Interval:
    """Return the mean of the classes' accuracies, with a bootstrap interval over objects.

    Args:
        correct, labels, objects: (sweep,) True if right, the true class, and the object.
    """

    def mean(at: Labels) -> float:
        count = np.bincount(labels[at])
        right = np.bincount(labels[at], weights=correct[at])
        return float((right[count > 0] / count[count > 0]).mean())

    return bootstrap(mean, objects)


def run_on(model: "TactileClassifier", output: str = "logits") -> Step:
    """Return a function for `predict` that computes one output of a torch model."""
    import torch  # imported here, since a model file is measured without torch

    def run(*loads: Floats) -> Floats:
        model.eval()
        device = model.inputs.clip.device
        with torch.inference_mode():
            windows = [torch.from_numpy(a).to(device) for a in loads]
            if output == "logits":
                out = model(*windows)
            else:
                out = model.network.split(model.network.answer(model.inputs(*windows)))[output]
        return np.asarray(out.float().cpu().numpy())

    return run


def run_steps(session: ort.InferenceSession, card: ModelCard, refusals: bool = False) -> Step:
    """Return a function for `predict` that runs a model file loaded by `load_model`.

    Args:
        refusals: True if the logits include those of the refusals. Without them, posteriors are
            conditional on the model naming a class.

    Returns:
        A function of (samples, offset, sigma) of windows that returns logits (batch, step, label),
        divided by the temperature.
    """
    divisor = np.float32(card.temperature)
    kept = len(card.labels) if refusals else len(card.classes)

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        found = file_outputs(session, card, samples, offset, sigma)["logits"]
        return found[..., :kept] / divisor

    return run
