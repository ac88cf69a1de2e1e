"""A model's step by every engine that is installed: CPU time, and whether they decide alike."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.engines import DEFAULT, ENGINES, open_network
from tactile_rt.classifier.model_card import ModelCard, decided
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.errors import ConfigError, ModelError
from tactile_rt.evidence.records import Record
from tactile_rt.sources.opening import check_model, open_source

__all__ = [
    "AGREEMENT",
    "STREAM",
    "EngineSteps",
    "best_engine",
    "decide_stream",
    "engine_records",
    "measure_engines",
]

AGREEMENT = 99.9  # % of decisions, at least, that are onnxruntime's
WORTH = 0.95  # of onnxruntime's time: what gains less is within what a busy machine does
TURNS = 12  # at least; short, so that what else the machine does meets all engines
STREAM = "touches of correlated drifting loads, 0.3 to 30 times the scale, in the rated noise"


@dataclass
class EngineSteps:
    """What one engine did.

    Attributes:
        engine: The name of the engine.
        version: The release of its package.
        refused: The reason for which the engine cannot run the file; empty if it can.
        ms: (turn, step) CPU time of the process for each step, ms.
        labels: (decision) The decisions, as indices of the card's labels.
        stream: The name of the stream that the decisions are about.
        gap: The largest difference of a logit from that of onnxruntime, over the spread of those.
    """

    engine: str
    version: str
    refused: str = ""
    ms: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    labels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    gap: float = 0.0
    stream: str = STREAM

    @property
    def p50(self) -> float:
        """Median CPU time of a step, ms."""
        return float(np.median(self.ms))

    @property
    def tail(self) -> float:
        """The 99th percentile over the median."""
        return float(np.percentile(self.ms, 99) / self.p50)

    def over(self, other: "EngineSteps") -> float:
        """Its time over another's: median over turns of the ratio of the turn's medians."""
        return float(np.median(np.median(self.ms, axis=1) / np.median(other.ms, axis=1)))

    def agreement(self, other: "EngineSteps") -> float:
        """Share of decisions that are another's, %; 0 if there is none."""
        if not len(self.labels):
            return 0.0
        return float(100 * np.mean(self.labels == other.labels))


def measure_engines(path: Path, steps: int) -> list[EngineSteps]:
    """Step a file of kind "step" by all engines that are installed, in short turns.

    All step the same stream, and every turn begins with an episode. Onnxruntime comes first.

    Args:
        path: the ``.onnx`` file.
        steps: of each engine, in all, at least; rounded up to whole episodes.

    Raises:
        ModelError: onnxruntime cannot run it.
    """
    found, steppers = [], {}
    for name, engine in ENGINES.items():
        if not engine.version:
            continue
        measured = EngineSteps(name, engine.version)
        found.append(measured)
        try:
            network, card = open_network(path, name)
            steppers[name] = Stepper(network, card)
        except (ModelError, ConfigError) as error:
            if name == DEFAULT:
                raise
            measured.refused = str(error)
    episodes = -(-steps // card.steps)
    turns = min(TURNS, episodes)
    each = -(-episodes // turns)
    ms = {name: np.empty((turns, each * card.steps)) for name in steppers}
    logits: dict[str, list[NDArray[np.float32]]] = {name: [] for name in steppers}
    stream = _touches(card)
    for turn in range(-1, turns):  # one to warm up
        touches = [next(stream) for _ in range(each if turn >= 0 else 1)]
        for name, stepper in steppers.items():
            taken, said = _step(stepper, card, touches)
            if turn >= 0:
                ms[name][turn] = taken
                logits[name] += said
    first = np.stack(logits[DEFAULT])
    for measured in found:
        if measured.engine in ms:
            mine = np.stack(logits[measured.engine])
            measured.ms = ms[measured.engine]
            measured.labels = _decisions(card, mine)
            measured.gap = float(abs(mine - first).max() / first.std())
    return found


def decide_stream(path: Path, found: list[EngineSteps], url: str) -> None:
    """Let the decisions that are compared be those about a stream, of every step.

    Args:
        path: the ``.onnx`` file.
        found: the engines, as `measure_engines` gives them; their decisions are replaced.
        url: of a source that ends, as `tactile-rt run --source` takes it.

    Raises:
        SpecMismatch: the stream is of another array.
        ConfigError: there is no such source, it never ends, or nothing is touched in it.
    """
    check_model(path, url)
    with open_source(url) as source:
        if source.live:
            raise ConfigError(f"{url} is live: give what ends, such as a recording")
        chunks = list(source)
        spec = source.spec
    for measured in found:
        if not measured.refused:
            classifier = Classifier(path, spec, engine=measured.engine)
            labels = [d.label for chunk in chunks for d in classifier.push(chunk)]
            known = classifier.card.labels
            measured.labels, measured.stream = np.array([known.index(x) for x in labels]), url
    if not len(found[0].labels):
        raise ConfigError(f"{url}: nothing is touched in it, so nothing is decided")


def best_engine(found: list[EngineSteps]) -> EngineSteps:
    """The fastest whose decisions are onnxruntime's; onnxruntime where none is worth it."""
    default = found[0]
    able = [
        e for e in found[1:]
        if not e.refused and e.agreement(default) >= AGREEMENT and e.over(default) <= WORTH
    ]  # fmt: skip
    return min(able, key=lambda e: e.over(default), default=default)


def engine_records(found: list[EngineSteps], prefix: str) -> list[Record]:
    """What was found as figures, ``PREFIX.ENGINE.what`` each."""
    default, records = found[0], []
    for e in found:
        name = f"{prefix}.{e.engine.replace('-', '_')}"
        if e.refused:
            records.append(Record(f"{name}.steps", 0, "steps", how=e.refused))
            continue
        how = f"{e.engine} {e.version}, {e.ms.size} steps in {len(e.ms)} turns, one thread"
        records.append(Record(f"{name}.step_p50", e.p50, "ms CPU", how=how))
        p99 = e.p50 * e.tail
        records.append(Record(f"{name}.step_p99", p99, "ms CPU", how=f"{e.tail:.3g} x p50"))
        if e is default:
            continue
        records += [
            Record(
                f"{name}.over_onnxruntime", e.over(default), "x", how="median of turns side by side"
            ),
            Record(
                f"{name}.agreement", e.agreement(default), "%", f">= {AGREEMENT}",
                f"decisions of onnxruntime, {len(e.labels)} on {e.stream}",
                f"logits within {e.gap:.1e} of their spread",
            ),
        ]  # fmt: skip
    return records


def _step(
    stepper: Stepper, card: ModelCard, touches: list[NDArray[np.float32]]
) -> tuple[list[float], list[NDArray[np.float32]]]:
    """CPU time of each step, ms, and its logits. Of the process: an engine may have threads."""
    offset = np.zeros(card.array.shape, dtype=np.float32)
    sigma = np.broadcast_to(np.array(card.floor, dtype=np.float32), card.array.shape)
    taken, said = [], []
    for touch in touches:
        stepper.begin(offset, sigma)
        for samples in touch:
            stepper.samples[0] = samples
            began = time.process_time()
            logits = stepper.run()
            taken.append(1e3 * (time.process_time() - began))
            said.append(logits[0].copy())
    return taken, said


def _touches(card: ModelCard) -> Iterator[NDArray[np.float32]]:
    """Episodes (step, sub-step, element, channel), SI: see `STREAM`; the same on every machine."""
    rng = np.random.default_rng(0)
    elements, channels = card.array.shape
    count = card.steps * card.substeps
    scale, floor = np.array(card.scale), np.array(card.floor)
    while True:
        strength = 10 ** rng.uniform(-0.5, 1.5)
        among = rng.standard_normal((elements, 3)) @ rng.standard_normal((3, 3))  # few causes
        to = rng.standard_normal((3, elements, channels))
        drift = rng.standard_normal((count, 3)).cumsum(axis=0) / np.sqrt(count)
        common = np.einsum("tc,ec,ceh->teh", drift + rng.standard_normal(3), among, to)
        loads = strength * scale * common / max(float(common.std()), 1e-9)
        noise = rng.standard_normal(loads.shape) * floor
        shape = (card.steps, card.substeps, elements, channels)
        yield (loads + noise).astype(np.float32).reshape(shape)


def _decisions(card: ModelCard, logits: NDArray[np.float32]) -> NDArray[np.int64]:
    """Each step's decision, as the classifier takes it."""
    scaled = logits.astype(np.float64) / card.temperature
    posterior = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    posterior /= posterior.sum(axis=1, keepdims=True)
    steps = np.arange(len(logits)) % card.steps + 1
    return np.array(
        [decided(card, p.astype(np.float32), int(s)) for p, s in zip(posterior, steps, strict=True)]
    )
