"""Evaluation of a model file on unseen objects, for `tactile-rt eval`.

The model runs as on a robot: the ONNX file itself, step by step, from the onset that the contact
detector reports.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.errors import ConfigError, SpecMismatch, name_some
from tactile_rt.models.datasets import SweepSet, relabel_set
from tactile_rt.models.disturbances import Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measured_coverage import (
    NAMES_LEFT,
    measure_coverage,
    measure_names,
    named_faults,
    score_known,
)
from tactile_rt.models.evaluation.measures import Floats, Labels, Names, run_steps
from tactile_rt.models.evaluation.records import Record, record_count, record_share
from tactile_rt.models.evaluation.robustness import measure_robustness, rated_amount
from tactile_rt.sets.manifest import WITHHELD

# By number of classes, for the shipped recipes `mouse12` and `default24`.
BARS = {
    12: {"top-1": ">= 91", "top-5": ">= 99", "fused": ">= 97"},
    24: {"top-1": ">= 82", "top-5": ">= 97", "fused": ">= 96", "noise": "<= 4"},
}
ECE_BAR = "<= 5"
# Sweeps per object: few, since robustness is measured under many conditions.
ROBUSTNESS_SWEEPS, QUICK_SWEEPS = 4, 2


def evaluate_model(
    model: Path,
    data: Path,
    svm: bool = False,
    pictures: Path | None = None,
    quick: bool = False,
) -> list[Record]:
    """Measure a model on the test split of a sweep set.

    Args:
        svm: compare with an RBF support vector machine that is fitted to the same windows.
        pictures: folder for ``confusion.png`` and ``accuracy_over_time.png``.
        quick: use two sweeps of each object: enough for comparisons, not for publication.

    Raises:
        ConfigError: the model may have been trained on test objects, does not know all of their
            categories, or has another sample period.
        SpecMismatch: the model was made for another array.
    """
    session, card = load_model(model)
    run = run_steps(session, card)
    test = _read_test(data, card, model, quick)
    labels, objects = test.sweeps.labels, test.sweeps.objects
    if _may_know_objects(card, test):
        raise ConfigError(f"{model} may have been trained on objects that {data} tests on")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
    sample = f"{len(set(objects.tolist()))} unseen objects, {len(labels)} sweeps"

    clean = measures.predict(test, run)
    # the bars apply to test objects from the same source as the training objects
    bars = {} if _has_other_source(test, card) else BARS.get(len(card.classes), {})

    def top(name: str, posteriors: Floats, how: str = sample, top: int = 1) -> Record:
        right = measures.hits(posteriors, labels, top)
        return record_share(name, measures.accuracy(right, objects), bars.get(name, ""), how)

    records = [
        top("top-1", clean[:, -1]),
        record_share(
            "top-1, macro",
            measures.macro_accuracy(measures.hits(clean[:, -1], labels), labels, objects),
            "",
            f"the mean over classes; {sample}",
        ),
        top("top-5", clean[:, -1], top=5),
        top("top-1 at step 14 of 22", clean[:, 13]),
    ]
    for sweeps, count, bar in ((2, "two", bars.get("fused", "")), (4, "four", "")):
        if np.unique(objects, return_counts=True)[1].max() >= sweeps:  # enough of one object
            fused = measures.fused_accuracy(clean[:, -1], labels, objects, sweeps)
            records.append(record_share(f"{count} sweeps fused", fused, bar, sample))
    settled = measures.deciding_step(clean, labels)
    step_ms = card.period_ns * card.substeps * 1e-6
    if settled.any():
        median = float(np.median(settled[settled > 0])) * step_ms
        how = f"from contact onset, where it is right in the end; {sample}"
        name = "models.time to the final decision"
        records.append(Record(name, median, "ms", anchor="median", how=how))
    noisy = measures.predict(test, run, 1.0)
    rated, period_ms = rated_amount(test), card.period_ns * 1e-6
    recorded = test.manifest.recorded
    added = f"white noise {rated} added to every {period_ms:g} ms sample"
    how = f"{sample}; {'none added to that of the recordings' if recorded else added}, "
    how += "undetected sweeps count as wrong"
    records.append(top("top-1 at rated noise", noisy[:, -1], how))
    lost, bar = records[0].value - records[-1].value, bars.get("noise", "")
    records.append(Record("models.points lost at rated noise", lost, "points", bar, how=how))
    if test.manifest.sensor is None and not recorded:
        # The same noise on samples of 1 kHz: the resampler's Hann kernel leaves 0.29.
        raw = measures.predict(test, run, float(np.sqrt(1.5 / 18)))
        how = f"{sample}; white noise {rated} on every 1 kHz sample, through the resampler"
        records.append(top("top-1 at rated noise of 1 kHz samples", raw[:, -1], how))
    few = _take_first_sweeps(test, ROBUSTNESS_SWEEPS)
    records += measure_robustness(few, run, clean[_first_sweeps(objects, ROBUSTNESS_SWEEPS), -1])
    records += _measure_calibration(
        clean[:, -1], noisy[:, -1], labels, objects, card.temperature, sample
    )
    undetected = 100 * float(np.isnan(clean[:, 0, 0]).mean())
    records.append(Record("models.undetected sweeps", undetected, "%", "", "", sample))
    unknown = None
    if test.manifest.split.get(WITHHELD):
        unknown = replace(SweepSet.read(data, WITHHELD), window=test.window)
        if quick:
            unknown = _take_first_sweeps(unknown, QUICK_SWEEPS)
        records.append(_measure_open_set(model, unknown, test))
    records += _measure_coverage(model, test, unknown, sample)
    records += _measure_names(model, test, sample)
    if svm:
        right = measures.hits(clean[:, -1], labels)
        records += _compare_svm(data, card, test, right)
    if pictures is not None:
        from tactile_rt.models.evaluation.pictures import draw_confusion, draw_over_time

        table = measures.confusion(clean[:, -1], labels, len(card.classes))
        draw_confusion(table, card.classes, pictures / "confusion.png")
        curves = {
            "as recorded" if recorded else "no sensor noise": clean,
            f"rated noise ({rated} per sample)": noisy,
        }
        draw_over_time(curves, labels, objects, step_ms, pictures / "accuracy_over_time.png")
    return records


def _read_test(data: Path, card: ModelCard, model: Path, quick: bool) -> SweepSet:
    """Read a set's test split, with labels numbered and windows cut as for a model."""
    test, known = SweepSet.read(data, "test"), card.classes
    differences = card.array.differences(test.manifest.spec, ignore=("name", "rate_hz"))
    if differences:
        raise SpecMismatch(
            f"{model} was made for another array than that of {data}: " + "; ".join(differences)
        )
    if test.manifest.period_ns != card.period_ns:
        raise ConfigError(
            f"{model} takes a sample every {card.period_ns} ns, {data} has one every "
            f"{test.manifest.period_ns} ns"
        )
    strange = [name for name in test.manifest.categories if name not in known]
    if strange:
        raise ConfigError(
            f"{model} does not know {name_some(strange)} of {data}: leave them out of "
            "objects.categories, or name them in objects.withheld"
        )
    number = np.array([known.index(name) for name in test.manifest.categories])
    test = replace(test, sweeps=replace(test.sweeps, labels=number[test.sweeps.labels]))
    training = card.provenance.get("training")
    if isinstance(training, dict):
        test = replace(test, window=training.get("window", "onset"))
    return _take_first_sweeps(test, QUICK_SWEEPS) if quick else test


def _may_know_objects(card: ModelCard, test: SweepSet) -> bool:
    """Return whether the model may have been trained on objects of the test."""
    names = set(test.sweeps.objects.tolist())
    trained = card.provenance.get("trained_objects")
    if isinstance(trained, dict):
        return not names.isdisjoint(trained.get(test.manifest.source, ()))
    unseen = set(card.provenance.get("unseen_objects", ()))
    return not _has_other_source(test, card) and bool(unseen) and not names <= unseen


def _has_other_source(test: SweepSet, card: ModelCard) -> bool:
    """Return whether the test objects come from another source than the training objects."""
    trained: Any = card.provenance.get("sweep_set", {})
    source = trained.get("objects", {}).get("from") if isinstance(trained, dict) else None
    return source is not None and test.manifest.recipe.get("objects", {}).get("from") != source


def _measure_calibration(
    clean: Floats, noisy: Floats, labels: Labels, objects: Names, temperature: float, sample: str
) -> list[Record]:
    at = f"at temperature {temperature:.3g}"
    raw = measures.at_temperature(clean, 1 / temperature)
    cases = (
        ("", clean, ECE_BAR, at),
        (" without temperature scaling", raw, "", "logits as they were trained"),
        (" at rated noise", noisy, "", at),
    )
    records = []
    for name, posteriors, bar, how in cases:

        def ece(at: Labels, p: Floats = posteriors) -> float:
            return measures.expected_calibration_error(p[at], labels[at])

        estimate = measures.bootstrap(ece, objects)
        records.append(
            record_share(f"calibration error{name}", estimate, bar, f"15 bins, {how}; {sample}")
        )
    return records


def _measure_coverage(
    model: Path, test: SweepSet, unknown: SweepSet | None, sample: str
) -> list[Record]:
    records, refusals = [], set(load_model(model)[1].refusals)
    for noise, when in ((0.0, ""), (1.0, " at rated noise")):
        found = measure_coverage(model, test, Disturbance(noise=noise))
        if found is None:
            return []
        if found.nominal == found.nominal:
            how = f"nominal: {100 * found.nominal:g} %; {sample}"
            name = f"coverage of the prediction sets{when}"
            records.append(record_share(name, found.covered, "", how))
            name = f"prediction set at the last step{when}"
            records.append(record_count(name, found.size, sample))
        if UNKNOWN in refusals:
            records.append(
                record_share(f"known things called unknown{when}", found.unknown, "", sample)
            )
        if refusals - {UNKNOWN}:
            records.append(
                record_share(f"sound loads called faulty{when}", found.faulty, "", sample)
            )
    if unknown is not None and (found := measure_coverage(model, unknown)):
        how = f"{len(unknown.sweeps)} sweeps of withheld kinds"
        records.append(record_share("unknown things called unknown", found.unknown, "", how))
    for name, share in named_faults(model, test):
        records.append(record_share(f"{name}, named as a fault", share, "", sample))
    return records


def _measure_names(model: Path, test: SweepSet, sample: str) -> list[Record]:
    records = []
    for noise, when in ((0.0, ""), (1.0, " at rated noise")):
        for name, found in measure_names(model, test, Disturbance(noise=noise)):
            if name == NAMES_LEFT:
                records.append(record_count(f"{name}{when}", found, sample))
            else:
                records.append(record_share(f"{name}{when}", found, "", sample))
    return records


def _measure_open_set(model: Path, unknown: SweepSet, known: SweepSet) -> Record:
    there, here = score_known(model, unknown), score_known(model, known)
    estimate = measures.open_set(here, known.sweeps.objects, there, unknown.sweeps.objects)
    how = f"{len(here)} sweeps of known and {len(there)} of withheld kinds"
    name = "open set, known against withheld categories"
    return record_share(name, estimate, "", how, "% AUROC", "; 50: chance")


def _first_sweeps(objects: Names, sweeps: int) -> Labels:
    mine = [np.flatnonzero(objects == name)[:sweeps] for name in dict.fromkeys(objects.tolist())]
    return np.concatenate(mine)


def _take_first_sweeps(data: SweepSet, sweeps: int) -> SweepSet:
    return data[_first_sweeps(data.sweeps.objects, sweeps)]


def _compare_svm(
    data: Path, card: ModelCard, test: SweepSet, network: NDArray[np.bool_]
) -> list[Record]:
    """Compare a network's hits (sweep,) with those of an RBF SVM on the same windows."""
    from tactile_rt.models.evaluation.svm import fit_svm  # scikit-learn takes a second to import

    learnt_from = (  # with the model's labels, as the test has
        replace(relabel_set(SweepSet.read(data, split), card.classes), window=test.window)
        for split in ("train", "validation")
    )
    svm = fit_svm(*learnt_from)
    right, objects = svm.hits(test), test.sweeps.objects
    own = measures.accuracy(right, objects)
    above = measures.accuracy(network.astype(np.float64) - right, objects)
    same = "; the same test sweeps"
    return [
        record_share("RBF SVM top-1", own, "", svm.how, beside=same),
        record_share("points above the SVM", above, ">= 3", svm.how, "points", same),
    ]
