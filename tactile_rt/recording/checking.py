"""Checks of a recording: decisions by replaying the model, samples by decoding the packets again.

Decisions are compared by their content (`FACTS`), not by computing or wall-clock time. A model's
step does not depend on how its stream was cut or paced, so the same model on the same samples
decides the same, digit for digit. Packets are decoded again by this release, or by another codec,
and compared sample by sample.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import hash_of, shipped_model
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.settings import parse_toml
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, concatenate
from tactile_rt.recording.description import Description
from tactile_rt.recording.layout import WIRE
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.replay import prepare_replay

FACTS = ("onset_ns", "step", "t_ns", "final", "label", "probabilities",
         "prediction_set", "coverage", "names", "names_coverage",
         "object", "object_margin", "object_touches")  # fmt: skip
# A recording ends with its source; decisions about its last second may have come too late for it.
END_NS = NS_PER_S

Fields = Mapping[str, Any]


@dataclass(frozen=True)
class RecordedModel:
    """Model that the daemon ran on the source while recording it."""

    name: str  # name of the model in the configuration, and in its decisions
    file: Path  # path of the model's file at the time of recording
    sha256: str  # SHA-256 of the file, in hexadecimal; empty if not recorded
    table: Fields = field(default_factory=dict)  # model's table ``[[model]]`` in the configuration


def recorded_models(about: Description) -> tuple[RecordedModel, ...]:
    """Return the models that the daemon ran on the source while recording it."""
    session = about.session
    try:
        config = parse_toml(session.get("config", ""), "config").plain()
    except ConfigError:
        config = {}
    tables = {t["name"]: t for t in config.get("model", ()) if "name" in t}
    found = []
    for key, value in session.items():
        if not key.startswith("model."):
            continue
        name = key.removeprefix("model.").removeprefix("model.")
        table = tables.get(name, {})
        if table.get("source", session.get("daemon_source")) == session.get("daemon_source"):
            file, _, sha256 = value.rpartition(" sha256:")
            found.append(RecordedModel(name, Path(file), sha256, table))
    return tuple(found)


def live_model(
    what: str, about: Description, name: str, model: Path | None, check: bool
) -> RecordedModel | None:
    """Return the model that decided live; None if no model did.

    Args:
        name: name of the model; if empty, the only model, or the one whose file is `model`.

    Raises:
        ConfigError: no model has that name, or several models match.
    """
    models = recorded_models(about)
    names = ", ".join(m.name for m in models)
    if not models:
        if name or check:
            why = f"no model {name!r}" if name else "nothing to check"
            raise ConfigError(f"{what}: {why}: no model decided while it was recorded")
        return None
    named = [m for m in models if m.name == name] if name else list(models)
    if not named:
        raise ConfigError(f"{what}: no model {name!r} decided live; there are {names}")
    if len(named) > 1 and model is not None:
        same = hash_of(model)
        named = [m for m in named if m.sha256 == same] or named
    if len(named) > 1:
        raise ConfigError(f"{what}: several models decided live: choose by --name {names}")
    return named[0]


def choose_model_file(model: Path | None, live: RecordedModel | None) -> Path:
    """Return the model file to replay: `model`, else the live model's, else the shipped one.

    Raises:
        ConfigError: the file does not exist any more, or has changed.
    """
    if model is not None:
        return model
    if live is None:
        return shipped_model()
    if live.file.is_file() and live.sha256 in ("", hash_of(live.file)):
        return live.file
    if live.sha256 == hash_of(shipped_model()):  # at the path of another installation
        return shipped_model()
    raise ConfigError(
        f"the model that decided, {live.file} (sha256 {live.sha256[:16] or 'unknown'}), no "
        "longer exists: name one by --model"
    )


@dataclass(frozen=True)
class Checked:
    """Result of comparing replayed with recorded decisions."""

    same: int  # number of decisions that are as recorded
    before: int = 0  # number of recorded decisions from before the first recorded sample
    # number of replayed decisions of the last second, for which the recording ended too early
    late: int = 0
    # number of replayed decisions that were not recorded because they were late (``late = "skip"``)
    withheld: int = 0
    difference: str = ""  # first difference, in words; empty without any


def check_decisions(
    recorded: Sequence[Fields],
    replayed: Sequence[Fields],
    span_ns: tuple[int, int],
    *,
    final_only: bool = False,
    may_withhold: bool = False,
) -> Checked:
    """Compare recorded and replayed decisions of one model, one by one.

    Args:
        recorded: the model's decisions from `Recording.decisions`.
        replayed: decisions of every step, with the fields `FACTS`.
        span_ns: stream times of the first and last sample, ns.
        final_only: whether only final decisions were recorded.
        may_withhold: whether late decisions were not recorded.
    """
    kept = [d for d in recorded if d["t_ns"] >= span_ns[0]]
    mine = [d for d in replayed if d["final"] or not final_only]
    same = withheld = at = 0
    difference = ""
    before = len(recorded) - len(kept)
    for k, theirs in enumerate(kept, 1):
        while may_withhold and at < len(mine) and mine[at]["t_ns"] < theirs["t_ns"]:
            at, withheld = at + 1, withheld + 1
        if at == len(mine):
            difference = f"decision {k} ({_name_decision(theirs)}) is not decided again"
        elif found := _find_difference(theirs, mine[at]):
            difference = f"decision {k} ({_name_decision(theirs)}): {found}"
        if difference:
            break
        at, same = at + 1, same + 1
    left = [] if difference else mine[at:]
    if left and not may_withhold and left[0]["t_ns"] < span_ns[1] - END_NS:
        left, difference = [], f"a decision ({_name_decision(left[0])}) was not recorded"
    return Checked(same, before, len(left), withheld, difference)


def samples_given(chunk: Chunk, skips: Sequence[Fields]) -> Chunk | None:
    """Return the samples of a chunk that reached the live model; None if none did.

    Args:
        skips: from `Recording.skips`; samples of skips that are marked as lost are left out.
    """
    kept = np.ones(len(chunk), bool)
    for skip in skips:
        if skip["lost"]:
            kept &= (chunk.t_ns < skip["from_ns"]) | (chunk.t_ns >= skip["until_ns"])
    if kept.all():
        return chunk
    return chunk.select(kept) if kept.any() else None


def _name_decision(decision: Fields) -> str:
    return f"step {decision['step']} of the contact at {decision['onset_ns']} ns"


def _find_difference(recorded: Fields, replayed: Fields) -> str:
    for name in FACTS:
        if name not in recorded:  # an earlier release did not record it
            continue
        was, now = recorded[name], replayed[name]
        if name in ("prediction_set", "names"):
            was, now = list(was), list(now)  # JSON has no tuples
        if was == now:
            continue
        if name != "probabilities":
            return f"{name} was {was!r}, is {now!r}"
        if list(was) != list(now):
            return f"classes were {', '.join(was)}, are {', '.join(now)}"
        label = next(label for label in was if was[label] != now[label])
        return f"the probability of {label} was {was[label]}, is {now[label]}"
    return ""


Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class Redecoded:
    """Result of comparing recorded samples with samples decoded again from the packets."""

    recorded: int
    decoded: int
    equal: int = 0  # number of common samples with the same values and validity, bit for bit
    differing: int = 0  # number of common samples whose values or validity differ
    # number of differing samples with an element that is valid in only one of the two
    validity: int = 0
    # each channel that differs, its unit, and the largest difference where both samples are valid
    largest: tuple[tuple[str, str, float], ...] = ()
    time_ns: int = 0  # largest difference between the two times of one sample, ns
    # differences between the two arrays, in words; values are not compared then
    array: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the comparison as lines of text."""
        if self.array:
            return [
                f"{self.recorded} samples recorded, {self.decoded} decoded",
                f"another array: {'; '.join(self.array)}",
            ]
        both = self.equal + self.differing
        text = [
            f"{self.recorded} samples recorded, {self.decoded} decoded: {self.equal} are the same, "
            f"bit for bit, {self.differing} differ, {self.recorded - both} were recorded alone, "
            f"{self.decoded - both} decoded alone"
        ]
        if self.largest:
            parts = [f"{channel} {most:.3g} {unit}" for channel, unit, most in self.largest]
            text.append(f"they differ by at most {', '.join(parts)}")
        if self.validity:
            text.append(f"{self.validity} have elements that are valid in one of them alone")
        if self.time_ns:
            text.append(f"their times differ by at most {self.time_ns / 1e6:.3g} ms")
        return text


def compare_decoding(path: str | Path, options: Mapping[str, str] | None = None) -> Redecoded:
    """Decode a recording's packets again, and compare the result with its samples.

    Args:
        options: ``codec`` and the codec's own, as in a ``replay:`` URL; None for those recorded.

    Raises:
        ConfigError: the recording has no packets, or the codec is invalid.
        RecordingError: the recording has no samples, or the codec finds none in the packets.
    """
    recording = Recording(path)
    recorded = list(recording)
    fields = {**(options or {}), "from": WIRE, "speed": "0"}
    with prepare_replay(str(path), fields).open() as source:
        spec, decoded = source.spec, list(source)
    if not recorded or not decoded:
        raise RecordingError(
            f"{path}: {sum(map(len, recorded))} samples recorded, {sum(map(len, decoded))} decoded"
        )
    return _compare(recording.spec, concatenate(recorded), spec, concatenate(decoded))


def _compare(old_spec: ArraySpec, old: Chunk, new_spec: ArraySpec, new: Chunk) -> Redecoded:
    array = tuple(old_spec.differences(new_spec))
    if array:
        return Redecoded(len(old), len(new), array=array)
    ways = [_pair_by_number(old, new, old_spec.rate_hz), _pair_by_time(old, new, old_spec.rate_hz)]
    # Numbers restart in a file that continues a stream; without a device's counter, they shift
    # with each sample that only one side has.
    at, same = max(((way, _is_equal(old, new, way)) for way in ways), key=lambda w: int(w[1].sum()))
    i, j = at[0][~same], at[1][~same]
    both = (old.valid[i] & new.valid[j])[..., None]
    apart = np.where(both, np.abs(old.values[i] - new.values[j]), 0.0)
    most = np.fmax.reduce(apart, axis=(0, 1), initial=0.0)
    named = zip(old_spec.channels, old_spec.units, most.tolist(), strict=True)
    return Redecoded(
        len(old), len(new), int(same.sum()), len(i),
        int((old.valid[i] != new.valid[j]).any(axis=1).sum()),
        tuple((channel, unit, x) for channel, unit, x in named if x),
        int(np.abs(old.t_ns[at[0]] - new.t_ns[at[1]]).max(initial=0)),
    )  # fmt: skip


def _is_equal(old: Chunk, new: Chunk, at: Pairs) -> NDArray[np.bool_]:
    i, j = at
    bits = old.values[i].view(np.uint32) == new.values[j].view(np.uint32)
    same: NDArray[np.bool_] = bits.all(axis=(1, 2)) & (old.valid[i] == new.valid[j]).all(axis=1)
    return same


def _pair_by_number(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Pair samples by number, after removing the most frequent shift between the numbers."""
    rows = {row.tobytes(): k for k, row in enumerate(old.values)}
    like = [(rows[bits], k) for k, row in enumerate(new.values) if (bits := row.tobytes()) in rows]
    i, j = np.array(like, np.intp).T if like else _pair_by_time(old, new, rate_hz)
    shifts, counts = np.unique(new.seq[j] - old.seq[i], return_counts=True)
    shift = shifts[counts.argmax()] if len(shifts) else 0
    _, i, j = np.intersect1d(old.seq, new.seq - shift, return_indices=True)
    return i, j


def _pair_by_time(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Pair samples whose times are at most half a period apart."""
    middle = (old.t_ns[1:] + old.t_ns[:-1]) // 2
    nearest = np.searchsorted(middle, new.t_ns)
    near = np.abs(old.t_ns[nearest] - new.t_ns) <= NS_PER_S / rate_hz / 2
    i, first = np.unique(nearest[near], return_index=True)
    return i, np.flatnonzero(near)[first]
