"""An anti-aliased resampler to a fixed period, shared by data sets and runtime.

Training windows and the live stream pass through the same code, so that the network never meets
at run time what it was not trained on.
"""

import itertools

import numpy as np

from tactile_rt.core.stream import NS_PER_S, Chunk, concatenate

# A silence beyond it (and two input periods) is skipped instead of filled with invalid rows.
LONGEST_GAP_NS = NS_PER_S
# Share of the kernel's nominal weight that an output needs. Half would blank a slow sensor whose
# samples jitter by a fifth of their period; much less would replace a lost sample by a neighbour.
LEAST_WEIGHT = 0.25


class Resampler:
    """A resampler of a stream of chunks to a fixed period, with a Hann kernel.

    Each output is the mean of the valid inputs within one output period either side, weighted by
    ``(1 + cos(pi dt / period)) / 2``. The weights are never negative, so a force never changes its
    sign and a step never overshoots, and every input contributes equally to the outputs in sum, so
    impulse is conserved. The cost is small: -6 dB at the output's Nyquist frequency, a zero at
    the output rate, and a delay of one output period. An input that already has the output's
    period passes unchanged. The result does not depend on how the input was cut into chunks.

    Args:
        period_ns: output period, ns.
        input_rate_hz: nominal input rate; below the output rate the kernel widens to the input's
            period, which interpolates.
        aligned: whether outputs are at whole periods of the clock, so that several streams' outputs
            coincide; else the first is as early as possible.

    Attributes:
        out_of_order: The number of input samples that were dropped because they were not later
            than the one before.
    """

    def __init__(self, period_ns: int, input_rate_hz: float, aligned: bool = False) -> None:
        self.period_ns = period_ns
        self.half_width_ns = max(period_ns, round(NS_PER_S / input_rate_hz))
        self._least_weight = LEAST_WEIGHT * self.half_width_ns * input_rate_hz / NS_PER_S
        self._longest_gap_ns = max(LONGEST_GAP_NS, 2 * self.half_width_ns)
        self.out_of_order = 0
        self._origin: int | None = 0 if aligned else None  # time of output 0
        self._next: int | None = None  # index of the next output
        self._held: Chunk | None = None  # inputs that a later output may still need

    def push(self, chunk: Chunk) -> Chunk | None:
        """Feed input samples; return the resampled outputs that these complete, or None.

        Args:
            chunk: (n, element, channel) The samples, in order of time.

        Returns:
            Outputs with `seq` counting output periods since the first (`aligned`: since time 0),
            `t_ns` at the kernel's centre, and `valid` False (value 0) where less than a quarter of
            the kernel's weight had a valid sample.
        """
        ordered = self._drop_disorder(chunk)
        if ordered is None:
            return None
        pieces = []
        for run in self._split_at_gaps(ordered):
            if self._held is not None and run.t_ns[0] - self._held.t_ns[-1] > self._longest_gap_ns:
                self._held = self._next = None
            pieces += self._resample(run)
        return concatenate(pieces) if pieces else None

    def _split_at_gaps(self, chunk: Chunk) -> list[Chunk]:
        """Split a chunk at gaps in time that are too long to fill."""
        cuts = np.flatnonzero(np.diff(chunk.t_ns) > self._longest_gap_ns) + 1
        edges = [0, *cuts.tolist(), len(chunk)]
        return [chunk.select(slice(a, b)) for a, b in itertools.pairwise(edges)]

    def _drop_disorder(self, chunk: Chunk) -> Chunk | None:
        last = np.iinfo(np.int64).min if self._held is None else self._held.t_ns[-1]
        newest = np.maximum.accumulate(np.concatenate([[last], chunk.t_ns]))
        keep = chunk.t_ns > newest[:-1]
        self.out_of_order += int((~keep).sum())
        if keep.all():
            return chunk
        return chunk.select(keep) if keep.any() else None

    def _resample(self, chunk: Chunk) -> list[Chunk]:
        filled_ns = int(chunk.t_ns[0]) + self.half_width_ns  # samples on both sides of the kernel
        if self._origin is None:
            self._origin = filled_ns
        if self._next is None:
            self._next = -(-(filled_ns - self._origin) // self.period_ns)
        held = chunk if self._held is None else concatenate([self._held, chunk])
        # An output is complete when its kernel's end has been reached (the weight there is zero).
        ready = (int(held.t_ns[-1]) - self.half_width_ns - self._origin) // self.period_ns + 1
        out = [self._compute_output(held, k) for k in range(self._next, ready)]
        self._next = max(self._next, ready)
        oldest = self._origin + self._next * self.period_ns - self.half_width_ns
        keep = min(int(np.searchsorted(held.t_ns, oldest)), len(held) - 1)
        self._held = held.select(slice(keep, None))
        return out

    def _compute_output(self, held: Chunk, k: int) -> Chunk:
        assert self._origin is not None
        centre = self._origin + k * self.period_ns
        lo = np.searchsorted(held.t_ns, centre - self.half_width_ns, side="right")
        hi = np.searchsorted(held.t_ns, centre + self.half_width_ns, side="left")
        phase = (held.t_ns[lo:hi] - centre) * (np.pi / self.half_width_ns)
        weight = (0.5 + 0.5 * np.cos(phase)).astype(np.float32)  # (m,)
        usable = held.valid[lo:hi] & np.isfinite(held.values[lo:hi]).all(axis=2)  # (m, element)
        weights = weight[:, None] * usable
        total = weights.sum(axis=0)  # (element,)
        valid = total > self._least_weight
        values = np.where(usable[..., None], held.values[lo:hi], 0.0)
        mean = np.einsum("me,mec->ec", weights, values) / np.where(valid, total, 1.0)[:, None]
        mean[~valid] = 0.0
        return Chunk(
            np.array([k], dtype=np.int64),
            np.array([centre], dtype=np.int64),
            mean[None].astype(np.float32),
            valid[None],
        )
