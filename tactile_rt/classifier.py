"""The classifier: push chunks, get decisions. ONNX Runtime and numpy only.

    Chunk -> Resampler -> ContactDetector -> model step (explicit state) -> Classification

Contact onset starts an episode: the recurrent state is zeroed, and every completed step gives a
decision, the last of them final. Without contact there is no decision. A silence too long for the
resampler to bridge ends an episode early.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.contact import ContactDetector
from tactile_rt.model_file import load_model
from tactile_rt.stream import ArraySpec, Chunk, SpecMismatch
from tactile_rt.timebase import Resampler

__all__ = ["Classification", "Classifier", "fuse"]

# What a model does not depend on: the array's name, and its rate, to which we resample.
ADAPTED = ("name", "rate_hz")


@dataclass(frozen=True)
class Classification:
    """A decision during an episode.

    Attributes:
        onset_ns: stream time at which contact began, ns.
        t_ns: stream time of the last resampled sample used, ns.
        step: steps since onset, counted from 1.
        final: the episode's last step; an episode that a silence of the stream cuts short has
            none.
        label: the most probable class.
        labels: all class names.
        probabilities: (class,) float32 posterior.
        latency_s: time the model step took, s.
    """

    onset_ns: int
    t_ns: int
    step: int
    final: bool
    label: str
    labels: tuple[str, ...]
    probabilities: NDArray[np.float32]
    latency_s: float

    def top(self, k: int = 5) -> list[tuple[str, float]]:
        """The k most probable classes with their probabilities."""
        order = np.argsort(-self.probabilities, kind="stable")[:k]
        return [(self.labels[i], float(self.probabilities[i])) for i in order]


class Classifier:
    """A model file, run on a stream.

    Args:
        model: path of the ``.onnx`` file.
        spec: the array that the stream comes from.

    Attributes:
        card: the model's metadata.
        detector: contact state and tare of the stream.
        tared: last resampled sample less the tare, (element, channel) SI; zeros before the tare.

    Raises:
        ModelError: the file cannot be used.
        SpecMismatch: the model was made for another array; the message says where they differ.
    """

    def __init__(self, model: Path, spec: ArraySpec) -> None:
        self._session, self.card = load_model(model)
        differences = self.card.array.differences(spec, ignore=ADAPTED)
        if differences:
            raise SpecMismatch(
                f"{model} was made for another array than {spec.name!r}: " + "; ".join(differences)
            )
        self.detector = ContactDetector(spec.shape, np.array(self.card.floor, dtype=np.float32))
        self.tared = np.zeros(spec.shape, dtype=np.float32)
        self._resampler = Resampler(self.card.period_ns, spec.rate_hz)
        self._outputs = [o.name for o in self._session.get_outputs()]
        self._samples = np.zeros((1, self.card.substeps, *spec.shape), dtype=np.float32)
        self._filled = 0  # sub-steps of the step under way
        self._step = 0  # steps done; 0 also when no episode is under way
        self._onset_ns: int | None = None
        self._next_seq = 0
        self._begin()
        self._run()  # the first run allocates; let it not be a decision

    def push(self, chunk: Chunk) -> list[Classification]:
        """Take samples as they come from the array, return the decisions that they complete."""
        resampled = self._resampler.push(chunk)
        if resampled is None:
            return []
        decisions = []
        for i in range(len(resampled)):
            if resampled.seq[i] != self._next_seq:
                self._onset_ns = None  # what is touched now need not be what was touched before
            self._next_seq = int(resampled.seq[i]) + 1
            decision = self._sample(int(resampled.t_ns[i]), resampled.values[i], resampled.valid[i])
            if decision is not None:
                decisions.append(decision)
        return decisions

    def _sample(
        self, t_ns: int, sample: NDArray[np.float32], valid: NDArray[np.bool_]
    ) -> Classification | None:
        begins = self.detector.update(sample, valid)
        # An element without a trustworthy value, or without a tare, reads as untouched.
        trusted = valid & self.detector.tared
        sample = np.where(trusted[:, None], sample, self.detector.offset)
        self.tared = sample - self.detector.offset
        if begins and (self._onset_ns is None or self._step == self.card.steps):
            self._onset_ns = t_ns
            self._begin()
        if self._onset_ns is None:
            return None
        if self._step == self.card.steps:
            if not self.detector.contact:
                self._onset_ns = None  # released: the next contact is a new episode
            return None
        self._samples[0, self._filled] = sample
        self._filled += 1
        if self._filled < self.card.substeps:
            return None
        return self._decide(t_ns, self._onset_ns)

    def _decide(self, t_ns: int, onset_ns: int) -> Classification:
        began = time.perf_counter()
        logits = self._run() / self.card.temperature
        latency = time.perf_counter() - began
        self._filled = 0
        self._step += 1
        probabilities = np.exp(logits - logits.max())
        probabilities /= probabilities.sum()
        return Classification(
            onset_ns=onset_ns,
            t_ns=t_ns,
            step=self._step,
            final=self._step == self.card.steps,
            label=self.card.labels[int(probabilities.argmax())],
            labels=self.card.labels,
            probabilities=probabilities,
            latency_s=latency,
        )

    def _begin(self) -> None:
        self._filled = self._step = 0
        self._feed = {
            "samples": self._samples,
            "offset": self.detector.offset[None],
            "sigma": self.detector.sigma[None],
            **{s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in self.card.state},
        }

    def _run(self) -> NDArray[np.float32]:
        outputs = dict(zip(self._outputs, self._session.run(None, self._feed), strict=True))
        for state in self.card.state:
            self._feed[state.name] = outputs[f"{state.name}_next"]
        logits: NDArray[np.float32] = outputs["logits"][0]
        return logits


def fuse(posteriors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Combine posteriors (class,) of independent sweeps of one object: their normalised product.

    Assumes equal priors, as the training sets have.

    Raises:
        ValueError: no posteriors.
    """
    evidence = np.log(np.clip(np.stack(posteriors), 1e-12, None)).sum(axis=0)
    fused = np.exp(evidence - evidence.max())
    normalised: NDArray[np.float32] = (fused / fused.sum()).astype(np.float32)
    return normalised
