"""Sweeps of the whole catalogue, drawn at random, beside themselves in finer steps."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.objects.catalogue import CATEGORIES, WITHHELD, make_object
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation, draw_simulation
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile, array_spec

Floats = NDArray[np.float64]

SEED = 20
DRAWS, QUICK_DRAWS = 3, 9  # of each category; of all
LATER = 1000  # objects from here on were never trained on
FINE = Profile(links=20, timestep_ms=0.05, layer_mm=0.004)
FINER = replace(FINE, timestep_ms=0.025)
APART = 0.05  # moments of the two finest runs that differ by more: judged apart
MEAN_MS = 9  # networks see means over so long
FAINT = 1e-3  # spikes are sought above this share of the largest force on the array
ONSET_N = 2e-6  # of a whisker's force, at which it counts as touched
REST_MS = 300
NS_PER_MS = 1_000_000
NOISE = (1e-6,) * 3 + (1e-8,) * 3  # N and N m, of the stream that the model labels


@dataclass(frozen=True)
class Difference:
    """A sweep beside the same sweep in finer steps, the object at the same place.

    Attributes:
        moment, force: RMS of the difference over all whiskers, axes and samples, over the RMS of
            the finer sweep's.
        spike: Largest force on a whisker over the largest in the finer sweep, the worst of all
            whiskers that feel more than `FAINT` of the largest force on the array.
        onset_ms: Largest difference of the times at which a whisker is touched first, ms.
    """

    moment: float
    force: float
    spike: float
    onset_ms: float


def difference(loads: Floats, truth: Floats) -> Difference:
    """What differs between (sample, whisker, 6) loads and finer ones."""

    def off(channels: slice) -> float:
        wrong, right = (loads - truth)[..., channels], truth[..., channels]
        return float(np.sqrt(np.mean(wrong**2) / np.mean(right**2)))

    size, wanted = (np.linalg.norm(x[..., :3], axis=-1) for x in (loads, truth))
    most, right = size.max(axis=0), wanted.max(axis=0)
    both = (most > ONSET_N) & (right > ONSET_N)
    first, should = ((x > ONSET_N).argmax(axis=0)[both] for x in (size, wanted))
    return Difference(
        moment=off(slice(3, 6)),
        force=off(slice(0, 3)),
        spike=float((most / np.maximum(right, FAINT * right.max())).max()),
        onset_ms=float(abs(first - should).max(initial=0)) * SAMPLE_MS,
    )


def drawn(quick: bool) -> list[tuple[str, Sweep]]:
    """Names of objects and how they are swept: every category, or some of them."""
    every = [(c, d) for c in (*CATEGORIES, *WITHHELD) for d in range(DRAWS)]
    rng = np.random.default_rng(SEED)
    chosen = rng.permutation(len(every))[:QUICK_DRAWS] if quick else range(len(every))
    sweeps = []
    for i in chosen:
        category, draw = every[i]
        of = np.random.default_rng([SEED, i])
        index = LATER + draw
        thing = make_object(category, index)
        sweep, _ = draw_simulation(of, load_array("mouse"), thing, PROFILES["realtime"])
        sweeps.append((f"{category}-{index}", sweep))
    return sweeps


def _loads(name: str, sweep: Sweep, profile: Profile) -> Floats:
    category, _, index = name.rpartition("-")
    thing = make_object(category, int(index))
    simulation = SweepSimulation(load_array("mouse"), thing, sweep, profile)
    return simulation.advance(int(simulation.duration_ms / SAMPLE_MS))


def _label(loads: Floats, spec: ArraySpec) -> str:
    """The shipped model's last decision on a stream with a sensor's noise; empty: none."""
    classifier = Classifier(shipped_model(), spec)
    rng = np.random.default_rng(SEED)
    whole = np.concatenate([np.zeros((REST_MS, *loads.shape[1:])), loads])
    values = (whole + rng.normal(size=whole.shape) * NOISE).astype(np.float32)
    seq = np.arange(len(values), dtype=np.int64)
    stream = Chunk(seq, seq * NS_PER_MS, values, np.ones(values.shape[:2], dtype=np.bool_))
    labels = [d.label for d in classifier.push(stream)]
    return labels[-1] if labels else ""


def catalogue(quick: bool, keys: tuple[str, ...] = ("dataset", "realtime")) -> list[Record]:
    """Median, 95th percentile and worst of all differences; the worst one is the record's value."""
    sweeps = drawn(quick)
    array = load_array("mouse")
    spec = array_spec(array.whiskers, array.name)
    raw: dict[str, list[Difference]] = {key: [] for key in keys}
    mean: dict[str, list[Difference]] = {key: [] for key in keys}
    other: dict[str, list[str]] = {key: [] for key in keys}
    apart = []
    for name, sweep in sweeps:
        truth = _loads(name, sweep, FINE)
        finest = difference(_loads(name, sweep, FINER), truth)
        if finest.moment > APART:
            apart.append(f"{name} {finest.moment:.2f}")
            continue
        label = _label(truth, spec)
        for key in keys:
            loads = _loads(name, sweep, PROFILES[key])
            raw[key].append(difference(loads, truth))
            mean[key].append(difference(_means(loads), _means(truth)))
            if _label(loads, spec) != label:
                other[key].append(name)
    records = [
        Record(
            "sim.fine.apart",
            100 * len(apart) / len(sweeps),
            "%",
            "<= 10",
            f"sweeps whose moments differ by more than {APART} between {FINE.timestep_ms} and "
            f"{FINER.timestep_ms} ms",
            f"{len(apart)} of {len(sweeps)}, left out below: {', '.join(apart) or 'none'}",
        )
    ]
    bars = {
        ("dataset", "moment"): "<= 0.1",
        ("dataset", "spike"): "<= 3",
        ("realtime", "moment"): "<= 0.2",
        ("realtime", "spike"): "<= 4",
    }
    kinds: tuple[tuple[str, str, Callable[[Difference], float]], ...] = (
        ("moment", "", lambda d: d.moment),
        ("force", "", lambda d: d.force),
        ("spike", "x", lambda d: d.spike),
        ("onset", "ms", lambda d: d.onset_ms),
    )
    names = [n for n, _ in sweeps if n not in {a.split()[0] for a in apart}]
    for key in keys:
        for kind, unit, of in kinds:
            for suffix, found in (("", raw[key]), (f"_{MEAN_MS}ms", mean[key])):
                values = np.array([of(d) for d in found])
                records.append(
                    Record(
                        f"sim.{key}.catalogue_{kind}{suffix}",
                        float(values.max()),
                        unit,
                        "" if suffix else bars.get((key, kind), ""),
                        f"the same sweep at {FINE.timestep_ms} ms, {FINE.links} links",
                        f"worst of {len(values)} drawn sweeps: {names[int(values.argmax())]}; "
                        f"median {np.median(values):.3f}, 95 % {np.percentile(values, 95):.3f}",
                    )
                )
        records.append(
            Record(
                f"sim.{key}.catalogue_other_label",
                100 * len(other[key]) / len(names),
                "%",
                "",
                "the shipped model's label of the same sweep in fine steps",
                f"{len(other[key])} of {len(names)}: {', '.join(other[key]) or 'none'}",
            )
        )
    return records


def _means(loads: Floats) -> Floats:
    whole = len(loads) // MEAN_MS * MEAN_MS
    means: Floats = loads[:whole].reshape(-1, MEAN_MS, *loads.shape[1:]).mean(axis=1)
    return means
