"""Features of touches on any sensor: a network of random kernels, in which nothing is learnt.

An array's loads are reduced to a few signals: for every channel the sum over the elements, and for
the loads of a unit their centre and spread. Random temporal kernels filter the signals. Each kernel
gives three features: the share of time since the onset with an output above a threshold, the mean,
and the largest value (Dempster et al. 2021, doi:10.1145/3447548.3467231; Tan et al. 2022,
doi:10.1007/s10618-022-00844-1). They are so many that a few touches show which features matter.

Loads are divided by the largest of their unit since the onset: a soft and a firm touch of a kind
are alike, and the firmness is a feature of its own. So units and ranges do not matter, and the
network is the same for every sensor of so many elements and channels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec
from tactile_rt.teaching.onnx_bytes import OnnxGraph

KERNELS = 256
TAPS = 9
DILATIONS = (1, 2, 4, 8)  # samples between taps
MOST_SIGNALS = 3  # that a kernel filters
CENTRED = 0.7  # share of the kernels that ignore a constant
QUIET = 2.5  # standard deviations of an element's noise that count as no load
FAINT = 6.0  # standard deviations of the noise: fainter loads are not magnified further
LEAST = 1e-30  # below any output

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FeatureNetwork:
    """A network of random kernels that computes features of an array's stream, step by step."""

    spec: ArraySpec
    substeps: int
    kernels: Floats  # (kernel, signal, tap) weights of the temporal kernels
    dilations: NDArray[np.int64]  # (kernel,) number of samples from one tap to the next, ascending
    thresholds: Floats  # (kernel,) output of a kernel above which it counts as high

    @classmethod
    def draw(cls, spec: ArraySpec, substeps: int, steps: int, seed: int = 0) -> "FeatureNetwork":
        """Create an array's network with random kernels, equal for equal seeds on all machines."""
        rng = np.random.default_rng(seed)
        signals = sum(cls._count_signals(spec, unit) for unit in dict.fromkeys(spec.units))
        reach = [d for d in DILATIONS if d * (TAPS - 1) < 0.8 * steps * substeps] or [1]
        dilations = np.sort(rng.choice(reach, KERNELS))
        kernels = np.zeros((KERNELS, signals, TAPS))
        for kernel in kernels:
            seen = rng.choice(signals, rng.integers(1, min(MOST_SIGNALS, signals) + 1), False)
            taps = rng.normal(size=(len(seen), TAPS))
            taps -= taps.mean(axis=1, keepdims=True) * (rng.random() < CENTRED)
            kernel[seen] = taps / np.sqrt(np.square(taps).sum())
        thresholds = 0.5 * rng.normal(size=KERNELS)
        f = np.float32
        return cls(spec, substeps, kernels.astype(f), dilations, thresholds.astype(f))

    @staticmethod
    def _locate_elements(spec: ArraySpec) -> Floats:
        """Return centred coordinates (element, axis), -1 to 1, along axes with an extent."""
        places = np.array(spec.positions)
        if np.ptp(places, axis=0).max() == 0:  # no positions given
            places = np.array(spec.grid, dtype=float)
        places = places - (places.max(axis=0) + places.min(axis=0)) / 2
        extent = np.abs(places).max()
        lies = np.ptp(places, axis=0) > 0.05 * extent
        return np.asarray((places[:, lies] / max(extent, 1e-12)).astype(np.float32))

    @classmethod
    def _count_signals(cls, spec: ArraySpec, unit: str) -> int:
        """Return the number of signals that are made of the channels with a unit."""
        of_places = 1 + 2 * cls._locate_elements(spec).shape[1] if len(spec.elements) > 1 else 0
        return spec.units.count(unit) + of_places

    @property
    def past(self) -> int:
        """Number of earlier samples that a step needs."""
        return int(self.dilations.max()) * (TAPS - 1)

    @property
    def size(self) -> int:
        """Number of features in a step."""
        return 3 * len(self.kernels) + len(set(self.spec.units))

    def state(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each recurrent state of the network, by name."""
        n, signals = self.kernels.shape[:2]
        kept = {"count": (1,), "high": (n,), "total": (n,), "largest": (n,)}
        return {"past": (self.past, signals), "peak": (len(set(self.spec.units)),), **kept}

    def build(self, g: OnnxGraph) -> tuple[str, dict[str, str]]:
        """Add the inputs and operators of the network to a graph.

        Returns:
            The name of the (batch, feature) output, and that of each state's next value, by state.
        """
        elements, channels = self.spec.shape
        samples = g.input("samples", ["batch", self.substeps, elements, channels])
        offset = g.input("offset", ["batch", elements, channels])
        sigma = g.input("sigma", ["batch", elements, channels])
        before = {name: g.input(name, ["batch", *shape]) for name, shape in self.state().items()}
        load = g("Sub", samples, g("Unsqueeze", offset, g.integers(1)))
        load = g("Where", g("Less", g("Abs", load), g.constant(np.inf)), load, g.constant(0.0))
        noise = g("Where", g("Less", sigma, g.constant(np.inf)), sigma, g.constant(1e9))
        signals, peaks, times = [], [], []
        for unit in dict.fromkeys(self.spec.units):
            at = g.integers(*(i for i, u in enumerate(self.spec.units) if u == unit))
            of_unit = g("Gather", load, at, axis=3), g("Gather", noise, at, axis=2)
            found, peak = self._add_signals(g, *of_unit)
            signals.append(found)
            peaks.append(peak)
            times.append(self._count_signals(self.spec, unit))
        units = range(len(peaks))
        peak = g("Max", before["peak"], g("Concat", *peaks, axis=1))  # (batch, unit)
        which = g.integers(*(u for u in units for _ in range(times[u])))
        over = g("Unsqueeze", g("Gather", peak, which, axis=1), g.integers(1))  # (b, 1, signal)
        known = g("Concat", before["past"], g("Concat", *signals, axis=2), axis=1)
        relative = g("Transpose", g("Div", known, over), perm=[0, 2, 1])  # (b, signal, sample)
        outputs = []
        for dilation in np.unique(self.dilations).tolist():
            first = g.integers(self.past - dilation * (TAPS - 1))
            ends = g.integers(self.past + self.substeps)
            recent = g("Slice", relative, first, ends, g.integers(2))
            kernels = g.constant(self.kernels[self.dilations == dilation])
            shape = {"dilations": [dilation], "kernel_shape": [TAPS]}
            outputs.append(g("Conv", recent, kernels, **shape))
        out = g("Concat", *outputs, axis=1)  # (batch, kernel, sub-step)
        above = g("Greater", out, g.constant(self.thresholds[:, None]))
        ones = g("ReduceSum", g("Cast", above, to=1), g.integers(2), keepdims=0)
        high = g("Add", before["high"], ones)
        total = g("Add", before["total"], g("ReduceSum", out, g.integers(2), keepdims=0))
        first_step = g("Equal", before["count"], g.constant(0.0))
        largest = g("Where", first_step, g.constant(-1 / LEAST), before["largest"])
        largest = g("Max", largest, g("ReduceMax", out, g.integers(2), keepdims=0))
        count = g("Add", before["count"], g.constant(float(self.substeps)))
        features = g(
            "Concat", g("Div", high, count), g("Div", total, count), largest, g("Log", peak), axis=1
        )
        end = g.integers(self.substeps + self.past)
        past = g("Slice", known, g.integers(self.substeps), end, g.integers(1))
        return features, {
            "past": past, "peak": peak, "count": count, "high": high, "total": total,
            "largest": largest,
        }  # fmt: skip

    def _add_signals(self, g: OnnxGraph, load: str, noise: str) -> tuple[str, str]:
        """Add a unit's signals (batch, sub-step, signal) and peak to `g`; return both names."""
        summed = g("ReduceSum", load, g.integers(2), keepdims=0)  # (batch, sub-step, channel)
        level = g("Sqrt", g("ReduceSum", g("Mul", noise, noise), g.integers(2), keepdims=0))
        faint = g("Mul", g("ReduceMax", level, g.integers(1), keepdims=1), g.constant(FAINT))
        size = g("Sqrt", g("ReduceSum", g("Mul", summed, summed), g.integers(2), keepdims=0))
        peak = g("Max", g("ReduceMax", size, g.integers(1), keepdims=1), faint)  # (batch, 1)
        peak = g("Max", peak, g.constant(LEAST))
        if len(self.spec.elements) == 1:
            return summed, peak
        strength = g("Sqrt", g("ReduceSum", g("Mul", load, load), g.integers(3), keepdims=0))
        quiet = g("Mul", g("Unsqueeze", level, g.integers(1)), g.constant(QUIET))
        strength = g("Relu", g("Sub", strength, quiet))  # (batch, sub-step, element)
        whole = g("ReduceSum", strength, g.integers(2), keepdims=1)  # (batch, sub-step, 1)
        peak = g("Max", peak, g("ReduceMax", whole, g.integers(1), keepdims=0))
        axes = self._locate_elements(self.spec)
        share = g("Div", strength, g("Max", whole, g.constant(LEAST)))
        centre = g("MatMul", share, g.constant(axes))  # (batch, sub-step, axis)
        square = g("MatMul", share, g.constant(axes**2))
        spread = g("Sqrt", g("Relu", g("Sub", square, g("Mul", centre, centre))))
        # Weight places by the load, up to the peak, as all signals are divided by the peak.
        there = g("Unsqueeze", peak, g.integers(1))
        there = g("Min", g("Mul", whole, g.constant(4.0)), there)
        places = g("Mul", g("Concat", centre, spread, axis=2), there)
        return g("Concat", summed, whole, places, axis=2), peak

    @property
    def kinds(self) -> tuple[slice, ...]:
        """Slices of the features, one per kind: shares of time, means, largest values, peaks."""
        n = len(self.kernels)
        return slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n), slice(3 * n, None)
