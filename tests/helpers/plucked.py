"""Devices for tests: an array that is left alone and then plucked, as its file describes it."""

from pathlib import Path

import numpy as np

from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.rods.world import RodWorld
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.transducer import Transducer, device_spec

LINKS, STEPS = 10, 4
SWING_MS, APART_MS = 900, 1500


def swing(whisker: Whisker, angle: float, way: float) -> np.ndarray:
    """(sample, 8) loads at 1 kHz of a whisker whose tip was bent, rad in all, and let go."""
    root = np.concatenate([np.zeros((1, 3)), whisker.orientation])[None]
    world = RodWorld((whisker,), root, (), LINKS, STEPS)
    chain = world.rods[0].chain
    levers = np.cumsum(chain.length[::-1])[::-1][chain.clamped :]  # as under a force on the tip
    bend = levers / chain.stiffness[::2]
    bend *= angle / bend.sum()
    world.angles[0::2], world.angles[1::2] = bend * np.sin(way), bend * np.cos(way)
    loads = np.zeros((SWING_MS, 8))
    loads[:, :6] = world.advance(np.zeros((SWING_MS + 1, 3)))[0][:, 0]
    loads[:, 6:] = world.turns[:, 0]
    return loads


def plucked(
    file: Path,
    names: tuple[str, ...] = (),
    plucks: int = 3,
    rest_s: float = 70.0,
    angle: float = 0.4,
    seed: int = 0,
) -> tuple[ArraySpec, Chunk]:
    """What the device of an array's file delivers: rest, then plucks in directions that change.

    Args:
        file: describes the device as it is.
        names: of the whiskers that are plucked.
        plucks: of each.
        rest_s: before the first.
        angle: by which a whisker is bent, rad, give or take.
        seed: of directions, sizes and noise.
    """
    array = load_array(str(file))
    assert array.sensor is not None
    spec, rng = device_spec((array,)), np.random.default_rng(seed)
    still = np.zeros((round(rest_s * 1000), len(spec.elements), 8))
    pieces = [still]
    for name in names:
        index = spec.elements.index(name)
        for _ in range(plucks):
            loads = np.zeros((SWING_MS + APART_MS, *still.shape[1:]))
            size, way = angle * rng.uniform(0.7, 1.3), rng.uniform(0, 2 * np.pi)
            begin = int(rng.integers(APART_MS // 2))
            loads[begin : begin + SWING_MS, index] = swing(array.whiskers[index], size, way)
            pieces.append(loads)
    values = np.concatenate(pieces).astype(np.float32)
    seq = np.arange(len(values), dtype=np.int64)
    chunk = Chunk(seq, 10**9 + seq * 10**6, values, np.ones(values.shape[:2], np.bool_))
    read = Transducer(array.sensor, spec.elements).push(chunk)
    assert read is not None
    out = Sensor(SensorModel(), spec, seed, array.sensor).push(read)
    assert out is not None
    return spec, out
