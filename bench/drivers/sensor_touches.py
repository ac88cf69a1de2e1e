"""Made-up touches of five sensors of other kinds: patterns in time and place, no two alike.

A drawing is five kinds to teach, ten touches each, then 20 others of each, then ten of each of
three further kinds. Touches differ in strength (by 0.5 to 2), speed (0.7 to 1.4) and place.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.opening import make_codec

TAUGHT, TESTED, STRANGE = 10, 20, 10  # touches of a kind
SPEED = 0.35  # of its logarithm, either way
WAIT_S = 1.0, 1.5  # between touches
RESTS_S = 5.0, 15.0, 5.0  # before each part, besides: between teaching and tests it is learnt
EARLY_S = 0.15  # of an onset before its touch
LONG, WIDE = 0.6, 0.35  # of a fingertip, half pads


class TaughtSensor(NamedTuple):
    """The wire, which of six loads its channels are of, these in a usual touch, noise, rest."""

    wire: str
    loads: tuple[int, ...]  # forces along x, y, z; of all together the moments about them
    usual: Any
    noise: Any
    rest: Any = 0.0


SENSORS = {
    "bota": TaughtSensor(
        "serial", tuple(range(6)), (4,) * 3 + (0.08,) * 3, (0.04,) * 3 + (8e-4,) * 3
    ),
    "anyskin": TaughtSensor(
        "serial", (0, 1, 2, 2), (2e-4,) * 3 + (0,), (2e-6,) * 3 + (0.05,), (0, 0, 0, 298)
    ),
    "hx711_whisker": TaughtSensor("serial", (0, 1), 3e-3, 3e-5),
    "xela": TaughtSensor("can", (0, 1, 2), 2500, 15, 32_768),
    "icub_skin": TaughtSensor("can", (2,), -70, 1, 245),
}

Wave = Callable[[NDArray[np.float64]], Any]  # of a touch's time, 0 to 1


class TouchKind(NamedTuple):
    """A pattern.

    Attributes:
        press: The load.
        path: Where it is beside where it began, x + iy, half pads.
        turn: The angle by which a fingertip has turned.
        pull: The load along x, of that along z.
        hz: The fastest feature of the fastest touch.
    """

    press: Wave = lambda u: np.clip(np.minimum(u, 1 - u) / 0.15, 0, 1)
    path: Wave = lambda u: 0
    turn: float = 0.0
    pull: float = 0.0
    seconds: float = 0.8
    hz: float = 5.0


KINDS = {
    "press": TouchKind(),
    "tap": TouchKind(lambda u: np.sin(np.pi * u), seconds=0.15),
    "double": TouchKind(lambda u: np.maximum(np.sin(3 * np.pi * u), 0), seconds=0.5),
    "triple": TouchKind(lambda u: np.maximum(np.sin(5 * np.pi * u), 0)),
    "ramp": TouchKind(lambda u: np.minimum(u / 0.85, (1 - u) / 0.15)),
    "fade": TouchKind(lambda u: np.minimum(u / 0.1, (1 - u) / 0.9)),
    "tremble": TouchKind(lambda u: np.sin(np.pi * u) * (1 + 0.5 * np.sin(12 * np.pi * u)), hz=10.6),
    "buzz": TouchKind(lambda u: np.sin(np.pi * u) * (1 + 0.5 * np.sin(48 * np.pi * u)), hz=42.6),
    "rub": TouchKind(path=lambda u: 0.5j * np.sin(4 * np.pi * u)),
    "slide": TouchKind(path=lambda u: u - 0.5),
    "circle": TouchKind(path=lambda u: 0.4 * np.exp(2j * np.pi * u)),
    "side": TouchKind(path=lambda u: 0.7, pull=0.8),
    "twist": TouchKind(turn=1.5),
}


@dataclass(frozen=True)
class Drawing:
    """Touches of a sensor.

    Attributes:
        kinds: The kind of each touch: of those to teach, to test, and the strange ones.
        starts: When each begins, s.
        signal: (n, element, channel) What the sensor measures, with its noise.
        too_fast: The kinds with a feature above half the sensor's rate.
        tested, strange: The numbers of the first touches that test, and of the first strange one.
    """

    spec: ArraySpec
    kinds: list[str]
    starts: list[float]
    signal: NDArray[np.float32]
    too_fast: set[str]
    tested: int = 5 * TAUGHT
    strange: int = 5 * (TAUGHT + TESTED)

    def judge(self, found: Iterable[tuple[float, str]]) -> dict[str, float]:
        """Hold labels against the touches that were tested.

        Args:
            found: when something began, s, and what it was called.

        Returns:
            The percentages of known touches that were named rightly, and of those felt of strange
            kinds that were refused; how many touches were missed, and taken for several.
        """
        said: list[list[str]] = [[] for _ in self.kinds]
        for onset_s, label in found:
            said[max(0, int(np.searchsorted(self.starts, onset_s + EARLY_S)) - 1)].append(label)
        counts = [kind not in self.too_fast for kind in self.kinds]
        known = [
            said[k][:1] == [self.kinds[k]] for k in range(self.tested, self.strange) if counts[k]
        ]
        felt = [s[0] for k, s in enumerate(said) if k >= self.strange and s and counts[k]]
        return {
            "known": 100 * sum(known) / len(known),
            "refused": 100 * felt.count("unknown") / len(felt),
            "missed": said[self.tested :].count([]),
            "split": sum(len(s) > 1 for s in said),
        }


def draw_touches(name: str, drawing: int) -> Drawing:
    """Draw kinds, the same for every sensor, and a sensor's own touches of these."""
    sensor = SENSORS[name]
    spec = make_codec(sensor.wire, name, {}).spec
    assert spec is not None
    kinds = np.random.default_rng(drawing).permutation(list(KINDS))[:8]
    rng = np.random.default_rng((drawing, list(SENSORS).index(name)))
    tests = np.repeat(kinds[:5], TESTED), np.repeat(kinds[5:], STRANGE)
    parts = [np.repeat(kinds[:5], TAUGHT), *map(rng.permutation, tests)]
    places, felt, starts = _places(name, spec), [np.zeros((0, *spec.shape))], []
    for part, still_s in zip(parts, RESTS_S, strict=True):
        for kind in part.tolist():
            still_s += rng.uniform(*WAIT_S)
            felt.append(np.zeros((round(still_s * spec.rate_hz), *spec.shape)))
            starts.append(sum(map(len, felt)) / spec.rate_hz)
            loads = _touch(KINDS[kind], places, spec.rate_hz, rng)
            felt.append(sensor.usual * loads[..., sensor.loads])
            still_s = 0.0
    felt.append(np.zeros((round(RESTS_S[-1] * spec.rate_hz), *spec.shape)))
    whole = np.concatenate(felt) + sensor.rest
    whole += sensor.noise * rng.normal(size=whole.shape)
    too_fast = {kind for kind in kinds.tolist() if 2 * KINDS[kind].hz > spec.rate_hz}
    return Drawing(spec, np.concatenate(parts).tolist(), starts, whole.astype(np.float32), too_fast)


def _places(name: str, spec: ArraySpec) -> NDArray[np.complex128]:
    """(element,) x + iy of each, half pads."""
    rows, columns = np.array(spec.grid, float).T
    if name == "icub_skin":  # its triangles of 3 x 4 taxels lie four by four
        rows, columns = 4 * (rows // 4) + columns // 3, 3 * (rows % 4) + columns % 3
    centred = columns - columns.mean() + 1j * (rows - rows.mean())
    return np.asarray(centred / max(1, np.ptp(rows) / 2, np.ptp(columns) / 2))


def _touch(
    kind: TouchKind, places: NDArray[np.complex128], rate_hz: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """(n, element, load) of one touch, 1 where a usual one is strongest."""
    n = round(kind.seconds * np.exp(rng.uniform(-SPEED, SPEED)) * rate_hz)
    u = (np.arange(n)[:, None] + rng.random()) / n
    press, bend = 2 ** rng.uniform(-1, 1) * kind.press(u), np.exp(1j * rng.uniform(-0.3, 0.3))
    path = (kind.path(u) + 0j * u) * bend
    moved = np.gradient(path, axis=0)
    pull = kind.pull * bend + 0.4 * moved / (np.abs(moved).max() + 1e-9)  # friction
    centre, turns = path + complex(*rng.uniform(-0.25, 0.25, 2)), kind.turn > 0
    moment, spin = -1j * press * centre, press * ((centre.conj() * pull).imag + turns)
    if len(places) > 1:  # they feel what is near, and are pushed away from its middle
        away = places - centre
        tip = away * np.exp(-1j * kind.turn * u)
        press = press * np.exp(-((tip.real / LONG) ** 2) - (tip.imag / WIDE) ** 2)
        pull = pull + (0.5 + 1j * turns) * away
    side = press * pull
    loads = side.real, side.imag, press, moment.real, moment.imag, spin
    return np.stack(np.broadcast_arrays(*loads), axis=-1)
