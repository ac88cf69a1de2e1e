"""Enrolled objects: which of them touches are of, or none, from embeddings alone.

A network that was trained to tell objects apart puts touches of one object near each other. How
objects differ, and how touches of one do, was measured on objects that it was not trained on: two
Gaussians (probabilistic linear discriminant analysis: Ioffe 2006, doi:10.1007/11744085_41). They
give the log odds that touches are of an object, of which some touches are known, against one of
which none are. Below a threshold they are of none that is enrolled. Network, Gaussians and
thresholds are fitted to last steps: of embeddings of earlier ones the rule promises nothing.
"""

from collections.abc import Sequence
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.classifier.decision_rules import MAX_NAME, Count, Positive, Share, named

NONE_OF_THESE = "none of these"  # what is decided of an object that is not enrolled
LOG_ODDS = "log odds"  # the score of an `IdentityRule`: of the same object

Floats = NDArray[np.float64]


ENROLLED, JUDGED = 5, 2  # touches, at most, that thresholds tell apart


class IdentityRule(msgspec.Struct, frozen=True):
    """When touches are of an enrolled object. Bytes are float16, little-endian.

    Attributes:
        score: The name of the score: `LOG_ODDS`.
        refused: The share of touches of enrolled objects that are refused.
        among: The numbers of enrolled objects that thresholds are for, ascending from 1; between
            them they are interpolated over the logarithm.
        thresholds: (among, 5, 2) The score below which touches are refused, by the number of
            objects, of touches that the object was enrolled by, from 1, and of touches that are
            judged, from 1; more count as 5 and 2.
        objects: The number of objects that all this was measured on.
        origin: (unit,) The mean of objects.
        directions: (unit, direction) The map to directions in which touches of an object have the
            variance 1 each.
        between: (direction,) The variance of objects in them.
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
    """An object that was enrolled.

    Attributes:
        touches: The number of touches that it was enrolled by.
        mean: (unit,) The mean of their embeddings, float16, little-endian.
    """

    name: str
    touches: Count
    mean: bytes

    @classmethod
    def of(cls, name: str, embeddings: NDArray[Any]) -> Self:
        """Enrol an object by its touches (touch, unit)."""
        return cls(name, len(embeddings), embeddings.mean(axis=0).astype("<f2").tobytes())


def identify(
    rule: IdentityRule, objects: Sequence[EnrolledObject], embeddings: Sequence[NDArray[Any]]
) -> tuple[str, float]:
    """Tell which enrolled object touches of one thing are of.

    Args:
        embeddings: (unit,) of each touch, at its last step; order does not matter.

    Returns:
        The object's name, or `NONE_OF_THESE`; and by how much the score of the likeliest object is
        above its threshold, below 0 where it is refused.
    """
    means = _numbers(b"".join(one.mean for one in objects)).reshape(len(objects), -1)
    enrolled = np.array([one.touches for one in objects])
    touches = project(rule, np.mean(embeddings, axis=0))
    found = margins(rule, project(rule, means), enrolled, touches, len(embeddings))
    best = int(found.argmax())
    return objects[best].name if found[best] >= 0 else NONE_OF_THESE, float(found[best])


def project(rule: IdentityRule, embeddings: NDArray[Any]) -> Floats:
    """Map embeddings (..., unit), or means of them, to the rule's directions."""
    origin = _numbers(rule.origin)
    directions = _numbers(rule.directions).reshape(len(origin), -1)
    return np.asarray((embeddings - origin) @ directions)


def margins(
    rule: IdentityRule,
    objects: Floats,
    enrolled: NDArray[np.intp],
    touches: Floats,
    judged: int = 1,
) -> Floats:
    """Compute by how much scores (..., object) are above their thresholds.

    Args:
        objects: (..., object, direction) the means of touches that they were enrolled by.
        enrolled: (..., object) how many these were.
        touches: (..., direction) the mean of those that are judged, of which there are so many.
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
    """Compute log odds (...) that touches are of an object, against an unknown one.

    Args:
        between: (direction,) variance of objects; that of touches of one is 1.
        objects, touches: (..., direction) means of so many touches each, enrolled and judged.
    """
    rest = between / (np.asarray(enrolled) * between + 1)  # the variance of where the object is
    own, any_object = rest + 1 / judged, between + 1 / judged
    away = touches - np.asarray(enrolled) * rest * objects
    each = touches**2 / any_object - away**2 / own + np.log(any_object / own)
    return np.asarray(each.sum(axis=-1) / 2)


def enrolment_fault(
    rule: IdentityRule | None, objects: Sequence[EnrolledObject], units: int
) -> str:
    """Say what makes a card's enrolment unusable; "" if nothing does."""
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
    numbers = map(_numbers, (rule.origin, rule.directions, *(one.mean for one in objects)))
    if not all(np.isfinite(one).all() for one in numbers):
        return "identity or enrolled: numbers that are none"
    names = [one.name for one in objects]
    if len({*names, NONE_OF_THESE}) <= len(names) or not all(map(named, names)):
        return f"names of enrolled objects repeat, are {NONE_OF_THESE!r}, or not printable"
    return ""


def _numbers(data: bytes) -> Floats:
    return np.frombuffer(data, "<f2").astype(float)
