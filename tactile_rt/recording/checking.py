"""Are these the decisions of the model that was recorded, and the samples of its packets?

A decision is what it says (`FACTS`); how long it took, and what the wall clock then was, are not
part of it. A model's step does not depend on how its stream was cut or paced, so the same model on
the same samples decides the same, digit for digit. Packets are decoded again by this release, or
by another codec, and compared sample by sample.
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
# A recording ends with its source; what was being decided just then came too late for it.
END_NS = NS_PER_S

Fields = Mapping[str, Any]


@dataclass(frozen=True)
class RecordedModel:
    """A model of the daemon that decided on the recorded source."""

    name: str  # name of the model in the configuration, and in its decisions
    file: Path  # path that the model's file had
    sha256: str  # SHA-256 of the file, in hexadecimal; empty: the recording does not tell
    table: Fields = field(default_factory=dict)  # model's table ``[[model]]`` in the configuration


def recorded_models(about: Description) -> tuple[RecordedModel, ...]:
    """The models that decided on the source while it was recorded; none without a daemon."""
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
    """The model that decided live; None: none did.

    Args:
        name: of the model; empty: the only one, or the one that `model` is.

    Raises:
        ConfigError: there is none of that name, or there are several.
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


def file_of_model(model: Path | None, live: RecordedModel | None) -> Path:
    """The file of the model that is to decide: `model`, or the one that did live.

    Raises:
        ConfigError: it is not there any more.
    """
    if model is not None:
        return model
    if live is None:
        return shipped_model()
    if live.file.is_file() and live.sha256 in ("", hash_of(live.file)):
        return live.file
    if live.sha256 == hash_of(shipped_model()):  # of another installation
        return shipped_model()
    raise ConfigError(
        f"the model that decided, {live.file} (sha256 {live.sha256[:16] or 'unknown'}), is not "
        "there any more: name one by --model"
    )


@dataclass(frozen=True)
class Checked:
    """What became of the comparison."""

    same: int  # number of decisions that are as recorded
    before: int = 0  # number of recorded decisions about samples before the first
    # number of replayed decisions of the last second, for which the recording ended too early
    late: int = 0
    # number of replayed decisions that were not recorded because they were late (``late = "skip"``)
    withheld: int = 0
    difference: str = ""  # first difference, in words; empty: there is none


def check_decisions(
    recorded: Sequence[Fields],
    replayed: Sequence[Fields],
    span_ns: tuple[int, int],
    *,
    final_only: bool = False,
    may_withhold: bool = False,
) -> Checked:
    """Compare decisions of one model, in their order.

    Args:
        recorded: as `Recording.decisions` gives them.
        replayed: with `FACTS`, of every step.
        span_ns: stream time of the first and the last sample.
        final_only: whether only final ones were recorded.
        may_withhold: whether late ones were not recorded.
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
            difference = f"decision {k} ({_of(theirs)}) is not decided again"
        elif found := _difference(theirs, mine[at]):
            difference = f"decision {k} ({_of(theirs)}): {found}"
        if difference:
            break
        at, same = at + 1, same + 1
    left = [] if difference else mine[at:]
    if left and not may_withhold and left[0]["t_ns"] < span_ns[1] - END_NS:
        left, difference = [], f"a decision ({_of(left[0])}) was not recorded"
    return Checked(same, before, len(left), withheld, difference)


def samples_given(chunk: Chunk, skips: Sequence[Fields]) -> Chunk | None:
    """The samples of a chunk that reached the model live; None: no one did.

    Args:
        skips: as `Recording.skips` gives them; where samples were lost, the model had none of them.
    """
    kept = np.ones(len(chunk), bool)
    for skip in skips:
        if skip["lost"]:
            kept &= (chunk.t_ns < skip["from_ns"]) | (chunk.t_ns >= skip["until_ns"])
    if kept.all():
        return chunk
    return chunk.select(kept) if kept.any() else None


def _of(decision: Fields) -> str:
    return f"step {decision['step']} of the contact at {decision['onset_ns']} ns"


def _difference(recorded: Fields, replayed: Fields) -> str:
    for name in FACTS:
        if name not in recorded:  # by an earlier release, that did not tell it
            continue
        was, now = recorded[name], replayed[name]
        if name in ("prediction_set", "names"):
            was, now = list(was), list(now)  # a message has no tuples
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
    """Recorded samples beside those that the packets decode to."""

    recorded: int
    decoded: int
    equal: int = 0  # number of samples of both whose values and validity are the same, bit for bit
    differing: int = 0  # number of samples of both whose values or validity are not the same
    # number of differing samples in which an element is valid in one of both alone
    validity: int = 0
    # each channel that differs, its unit, and the largest difference where both samples are valid
    largest: tuple[tuple[str, str, float], ...] = ()
    time_ns: int = 0  # largest difference between the two times of one sample, ns
    # differences between the two arrays, in words; values then are not compared
    array: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """It in words."""
        if self.array:
            return [
                f"{self.recorded} samples recorded, {self.decoded} decoded",
                f"another array: {'; '.join(self.array)}",
            ]
        both = self.equal + self.differing
        said = [
            f"{self.recorded} samples recorded, {self.decoded} decoded: {self.equal} are the same, "
            f"bit for bit, {self.differing} differ, {self.recorded - both} were recorded alone, "
            f"{self.decoded - both} decoded alone"
        ]
        if self.largest:
            parts = [f"{channel} {most:.3g} {unit}" for channel, unit, most in self.largest]
            said.append(f"they differ by at most {', '.join(parts)}")
        if self.validity:
            said.append(f"{self.validity} have elements that are valid in one of them alone")
        if self.time_ns:
            said.append(f"their times differ by at most {self.time_ns / 1e6:.3g} ms")
        return said


def compare_decoding(path: str | Path, options: Mapping[str, str] | None = None) -> Redecoded:
    """Decode a recording's packets again, and compare with its samples.

    Args:
        options: ``codec`` and the codec's own, as in a ``replay:`` URL; None: as recorded.

    Raises:
        ConfigError: there are no packets, or the codec cannot be.
        RecordingError: the codec finds no sample in them.
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
    return _compared(recording.spec, concatenate(recorded), spec, concatenate(decoded))


def _compared(old_spec: ArraySpec, old: Chunk, new_spec: ArraySpec, new: Chunk) -> Redecoded:
    array = tuple(old_spec.differences(new_spec))
    if array:
        return Redecoded(len(old), len(new), array=array)
    ways = [_by_number(old, new, old_spec.rate_hz), _by_time(old, new, old_spec.rate_hz)]
    # Numbers begin anew in a file that goes on with a stream; those of a device that does not
    # count shift with each sample that one of both has not.
    at, same = max(((way, _same(old, new, way)) for way in ways), key=lambda w: int(w[1].sum()))
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


def _same(old: Chunk, new: Chunk, at: Pairs) -> NDArray[np.bool_]:
    i, j = at
    bits = old.values[i].view(np.uint32) == new.values[j].view(np.uint32)
    same: NDArray[np.bool_] = bits.all(axis=(1, 2)) & (old.valid[i] == new.valid[j]).all(axis=1)
    return same


def _by_number(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Samples of the same number, but for what most numbers differ by."""
    rows = {row.tobytes(): k for k, row in enumerate(old.values)}
    like = [(rows[bits], k) for k, row in enumerate(new.values) if (bits := row.tobytes()) in rows]
    i, j = np.array(like, np.intp).T if like else _by_time(old, new, rate_hz)
    shifts, counts = np.unique(new.seq[j] - old.seq[i], return_counts=True)
    shift = shifts[counts.argmax()] if len(shifts) else 0
    _, i, j = np.intersect1d(old.seq, new.seq - shift, return_indices=True)
    return i, j


def _by_time(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Samples of the same moment: no further apart than half a period."""
    middle = (old.t_ns[1:] + old.t_ns[:-1]) // 2
    nearest = np.searchsorted(middle, new.t_ns)
    near = np.abs(old.t_ns[nearest] - new.t_ns) <= NS_PER_S / rate_hz / 2
    i, first = np.unique(nearest[near], return_index=True)
    return i, np.flatnonzero(near)[first]
