"""Identification of enrolled objects, and refusal of others, from the embeddings of touches.

A network that was trained to tell objects apart embeds touches of one object near each other. Two
Gaussians, fitted on objects that it was not trained on, describe how objects differ and how touches
of one object differ (probabilistic linear discriminant analysis: Ioffe 2006,
doi:10.1007/11744085_41). They give the log odds that touches are of an enrolled object, against an
unknown object. Below a threshold the touches are of no enrolled object. Network, Gaussians and
thresholds are fitted to last steps: for embeddings of earlier steps the rule guarantees nothing.
"""

from collections.abc import Sequence
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.classifier.decision_rules import MAX_NAME, Count, Positive, Share, is_printable_name

NONE_OF_THESE = "none of these"  # the decision on an object that is not enrolled
LOG_ODDS = "log odds"  # the score of an `IdentityRule`: of being the same object

Floats = NDArray[np.float64]


ENROLLED, JUDGED = 5, 2  # largest numbers of touches with thresholds of their own


class IdentityRule(msgspec.Struct, frozen=True):
    """A rule that identifies enrolled objects. Fields of bytes hold little-endian float16.

    Attributes:
        score: The name of the score: `LOG_ODDS`.
        refused: The share of touches of enrolled objects that are refused.
        among: The numbers of enrolled objects that have thresholds, ascending from 1; between them
            thresholds are interpolated over the logarithm.
        thresholds: (among, 5, 2) The score below which touches are refused, by the number of
            objects, of touches that the object was enrolled by, from 1, and of touches that are
            judged, from 1; more count as 5 and 2.
        objects: The number of objects that the rule was fitted on.
        origin: (unit,) The mean of objects.
        directions: (unit, direction) The map to directions in which touches of one object have
            variance 1.
        between: (direction,) The variance between objects in these directions.
    """

    score: str
    refused: Share
    among: tuple[Count, ...]
    thresholds: tuple[float, ...]
    objects: Count
    origin: bytes
    directions: bytes
    between: tuple[Positive, ...]


class EnrolledObject(msgspec.Struct, frozen=True):
    """An enrolled object: its name, and the mean embedding of a few touches.

    Attributes:
        touches: The number of touches that the object was enrolled by.
        mean: (unit,) The mean of their embeddings, float16, little-endian.
    """

    name: str
    touches: Count
    mean: bytes

    @classmethod
    def of(cls, name: str, embeddings: NDArray[Any]) -> Self:
        """Enrol an object by the embeddings (touch, unit) of its touches."""
        return cls(name, len(embeddings), embeddings.mean(axis=0).astype("<f2").tobytes())


def identify(
    rule: IdentityRule, objects: Sequence[EnrolledObject], embeddings: Sequence[NDArray[Any]]
) -> tuple[str, float]:
    """Identify an enrolled object, or none, from one or more touches of one object.

    Args:
        embeddings: The embedding (unit,) of each touch at its last step, in any order.

    Returns:
        The object's name, or `NONE_OF_THESE`; and the score of the likeliest object minus its
        threshold, below 0 if the object is refused.
    """
    means = _decode_float16(b"".join(one.mean for one in objects)).reshape(len(objects), -1)
    enrolled = np.array([one.touches for one in objects])
    touches = project(rule, np.mean(embeddings, axis=0))
    found = margins(rule, project(rule, means), enrolled, touches, len(embeddings))
    best = int(found.argmax())
    return objects[best].name if found[best] >= 0 else NONE_OF_THESE, float(found[best])


def project(rule: IdentityRule, embeddings: NDArray[Any]) -> Floats:
    """Project embeddings (..., unit), or their means, onto the rule's directions."""
    origin = _decode_float16(rule.origin)
    directions = _decode_float16(rule.directions).reshape(len(origin), -1)
    return np.asarray((embeddings - origin) @ directions)


def margins(
    rule: IdentityRule,
    objects: Floats,
    enrolled: NDArray[np.intp],
    touches: Floats,
    judged: int = 1,
) -> Floats:
    """Return how far the score of each object exceeds its threshold, (..., object).

    Args:
        objects: (..., object, direction) The mean of the touches that enrolled each object.
        enrolled: (..., object) The number of these touches.
        touches: (..., direction) The mean of the `judged` touches to identify.
    """
    between = np.array(rule.between)
    odds = log_odds(between, objects, enrolled[..., None], touches[..., None, :], judged)
    at = np.interp(np.log(objects.shape[-2]), np.log(rule.among), range(len(rule.among)))
    table = np.reshape(rule.thresholds, (-1, ENROLLED, JUDGED))[..., min(judged, JUDGED) - 1]
    least = table[int(at)] * (1 - at % 1) + table[int(np.ceil(at))] * (at % 1)  # (enrolled,)
    return np.asarray(odds - least[np.clip(enrolled, 1, ENROLLED) - 1])


def log_odds(
    between: Floats, objects: Floats, enrolled: ArrayLike, touches: Floats, judged: int
) -> Floats:
    """Return log odds (...) that touches are of an enrolled object, against an unknown object.

    Args:
        between: (direction,) The variance between objects; that of touches of one object is 1.
        objects, touches: (..., direction) The means of `enrolled` and of `judged` touches.
    """
    rest = between / (np.asarray(enrolled) * between + 1)  # variance left of the object's mean
    own, any_object = rest + 1 / judged, between + 1 / judged
    away = touches - np.asarray(enrolled) * rest * objects
    each = touches**2 / any_object - away**2 / own + np.log(any_object / own)
    return np.asarray(each.sum(axis=-1) / 2)


def enrolment_fault(
    rule: IdentityRule | None, objects: Sequence[EnrolledObject], units: int
) -> str:
    """Return why a card's enrolled objects and their rule cannot be used, or ""."""
    if rule is None:
        return "enrolled objects, but no rule `identity`" if objects else ""
    if rule.score != LOG_ODDS:
        return f"identity.score is {rule.score[:MAX_NAME]!r}, not {LOG_ODDS!r}: update tactile_rt"
    if rule.among[:1] != (1,) or len(rule.thresholds) != len(rule.among) * ENROLLED * JUDGED:
        return f"identity: {len(rule.thresholds)} thresholds among {str(rule.among)[:MAX_NAME]}"
    sizes = [len(rule.origin), len(rule.directions), *(len(one.mean) for one in objects)]
    if not rule.between or {*sizes[:1], *sizes[2:]} != {2 * units}:
        return f"identity: {sizes[:9]} bytes for {units} units"
    if sizes[1] != 2 * units * len(rule.between):
        return f"identity: {sizes[1]} bytes for {units} units, {len(rule.between)} directions"
    numbers = map(_decode_float16, (rule.origin, rule.directions, *(one.mean for one in objects)))
    if not all(np.isfinite(one).all() for one in numbers):
        return "identity or enrolled: numbers that are none"
    names = [one.name for one in objects]
    if len({*names, NONE_OF_THESE}) <= len(names) or not all(map(is_printable_name, names)):
        return f"names of enrolled objects repeat, are {NONE_OF_THESE!r}, or not printable"
    return ""


def _decode_float16(data: bytes) -> Floats:
    return np.frombuffer(data, "<f2").astype(float)
