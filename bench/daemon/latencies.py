"""From the array's write of the sample that completes a step to the decision in a peer's hand."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.daemon.accounts import RecordedSamples
from bench.daemon.peers import Ping
from bench.emulated import Played
from tactile_rt.core.stream import NS_PER_S

BEFORE_S, AFTER_S = 0.1, 1.0  # a fault counts for what is decided so long around it
BEGIN_S = 3.0  # until all have begun
PROMPT_MS = 2.0  # of a ping
QUIET, APART = "", "apart"


@dataclass(frozen=True)
class Latencies:
    """Of decisions that were undisturbed, and of others.

    Attributes:
        quiet: (n,) latency of each undisturbed decision, ms.
        faulty: (m,) latency of each decision near a fault, ms.
        calm: (n,) whether the machine was itself prompt during each undisturbed decision.
        kinds: The latencies (k,) near each kind of fault, ms, by the fault's name.
    """

    quiet: NDArray[np.float64]
    faulty: NDArray[np.float64]
    calm: NDArray[np.bool_]
    kinds: dict[str, NDArray[np.float64]]


def latencies(
    half_ns: int,
    recorded: RecordedSamples,
    played: dict[str, Played],
    name: str,
    t_ns: NDArray[np.int64],
    at_ns: NDArray[np.int64],
    ping: Ping | None = None,
    apart: Sequence[tuple[float, float]] = (),
) -> Latencies:
    """Of one array's decisions.

    Args:
        half_ns: length of the resampler's filter beyond the sample that it makes.
        recorded: of this array: a resampled sample is there as soon as a sample comes whose time
            is its own and `half_ns`.
        played: by all arrays; faults of one may disturb the others.
        name: of this array.
        t_ns: (n,) stream time of each decision's last sample.
        at_ns: (n,) host time at which the peer had it.
        ping: what the machine added; None: it is not known.
        apart: (from, to) in s of CLOCK_MONOTONIC, in which decisions count for nothing here: the
            machine had more to do than it can.
    """
    order = np.argsort(recorded.t_ns, kind="stable")
    ends = np.searchsorted(recorded.t_ns[order], t_ns + half_ns)
    known = ends < len(order)
    wrote = played[name].at_ns[recorded.seq[order][ends[known]]]
    took, when = (at_ns[known] - wrote) / 1e6, t_ns[known]
    cause = np.full(len(when), QUIET, dtype=object)
    for one in played.values():
        begun = int(one.at_ns[one.at_ns > 0][0])
        for kind, at_s, duration_s in one.faults:
            first = begun + round((at_s - BEFORE_S) * NS_PER_S)
            last = begun + round((at_s + duration_s + AFTER_S) * NS_PER_S)
            cause[(when > first) & (when < last)] = kind
    for begin, end in apart:
        first, last = round(begin * NS_PER_S), round((end + AFTER_S) * NS_PER_S)
        cause[(when > first) & (when < last)] = APART
    settled = (cause != APART) & (wrote > 0) & (when > played[name].at_ns[0] + BEGIN_S * NS_PER_S)
    quiet = (cause == QUIET) & settled
    return Latencies(
        took[quiet], took[(cause != QUIET) & settled],
        _calm(wrote[quiet], at_ns[known][quiet], ping),
        {str(kind): took[(cause == kind) & settled] for kind in set(cause[cause != QUIET])},
    )  # fmt: skip


def _calm(
    wrote: NDArray[np.int64], at_ns: NDArray[np.int64], ping: Ping | None
) -> NDArray[np.bool_]:
    """(n,) whether no ping from just before the write until the decision was in hand was late."""
    if ping is None:
        return np.ones(len(wrote), np.bool_)
    late = np.concatenate([[0], np.cumsum(ping.took_ms > PROMPT_MS)])
    first = np.searchsorted(ping.at_ns, wrote - round(1e9 * BEFORE_S))
    last = np.searchsorted(ping.at_ns, at_ns)
    calm: NDArray[np.bool_] = late[last] == late[first]
    return calm
