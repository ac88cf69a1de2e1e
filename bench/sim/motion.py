"""Whiskers let go, held and struck, beside fine steps and the laws of friction."""

from functools import cache
from itertools import pairwise

import numpy as np
import trimesh
from numpy.typing import NDArray

from bench.sim.pegs import PEG, PEG_RADIUS_MM
from tactile_rt.sim_backend.arrays.whiskers import Whisker, joint_stiffness
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.world import SAMPLE_MS, Profile

Floats = NDArray[np.float64]

FINE = Profile(40, 0.025, 0.01)  # the truth of a swing
FINEST = Profile(20, 0.002, 0.01)  # and of a strike
RELEASE_MS, STRIKE_MS, HELD_MS = 60, 40, 10_000
PLATE_MM = 0.2
SLOW_MM_S, FAST_ENOUGH_MM_S = (0.01, 0.1, 1.0), 3.0  # of slow ways; and where nothing depends on it
SLID_MM, PLACES = 0.1, 20
PLANE = slice(1, None, 2)  # of the joints, those that bend in the whisker's plane


def alone(whisker: Whisker, profile: Profile, *pieces: Piece) -> RodWorld:
    """Put a whisker at the origin, along x, among pieces."""
    root = np.concatenate([np.zeros((1, 3)), np.eye(3)])[None]
    steps = round(SAMPLE_MS / profile.timestep_ms)
    return RodWorld((whisker,), root, pieces, profile.links, steps)


def release(whisker: Whisker, profile: Profile, share: float) -> tuple[float, float]:
    """Let go a tip that was pushed by a share of the whisker's length.

    Returns:
        RMS of the error of the 1 kHz base moment over its RMS, and the first undershoot over that
        in fine steps.
    """
    found, truth = (_swing(whisker, p, share) for p in (profile, FINE))
    error = np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2))
    side = np.sign(truth[0])
    return float(error), float((side * found).min() / (side * truth).min())


@cache
def _swing(whisker: Whisker, profile: Profile, share: float) -> Floats:
    world = alone(whisker, profile)
    chain = world.rods[0].chain
    heading = np.cumsum(np.arctan2(chain.turn[:, 1], chain.turn[:, 0]))
    cell, n = whisker.length / profile.links, profile.links
    x = np.concatenate([[0.0], np.cumsum(chain.length * np.cos(heading))])
    bent = np.array([(x[-1] - x[1 + i]) / joint_stiffness(whisker, i * cell, (i + 1) * cell)
                     for i in range(n)])  # fmt: skip

    def tip(size: float) -> Floats:
        turned = heading + np.concatenate([[0.0], np.cumsum(size * bent)])
        place: Floats = np.array([chain.length @ np.cos(turned), chain.length @ np.sin(turned)])
        return place

    low, high = 0.0, 1.0 / abs(bent).sum()
    for _ in range(60):
        middle = (low + high) / 2
        near = np.linalg.norm(tip(middle) - tip(0.0)) < share * whisker.length
        low, high = (middle, high) if near else (low, middle)
    world.angles[PLANE] = low * bent
    moment: Floats = world.advance(np.zeros((RELEASE_MS + 1, 3)))[0][:, 0, 5]
    return moment


def hold(
    whisker: Whisker, profile: Profile, axis: int, depth: float = 0.05, place: float = 0.6
) -> Floats:
    """Press a peg on a whisker, slide it for half a millimetre along x or z, and hold it.

    Returns:
        (sample, 3) force on the base, mN; the last `HELD_MS` of them while it is held.
    """
    world = alone(whisker, profile, PEG)
    s = place * whisker.length
    x, y, _ = whisker.centreline(np.array([s]))[0]
    start = np.array([x, y + PEG_RADIUS_MM + float(whisker.radius(np.array([s]))[0]) + 0.05, 0.0])
    pressed, slid = np.zeros((2, 3))
    pressed[1], slid[axis] = -depth * whisker.length - 0.05, 0.5
    steps = [np.linspace(0, 1, 101)[1:], np.linspace(0, 1, 18)[1:]]
    way = np.concatenate([
        [start], start + np.outer(steps[0], pressed), start + pressed + np.outer(steps[1], slid),
        np.tile(start + pressed + slid, (HELD_MS, 1)),
    ])  # fmt: skip
    force: Floats = world.advance(way)[0][:, 0, :3] * 1e3
    return force


def strike(whisker: Whisker, profile: Profile, speed: float, place: float) -> float:
    """Drive a thin plate past a whisker, its edge at a share of the length.

    Args:
        speed: m/s.

    Returns:
        The error of the impulse on the base, relative, beside fine steps; 1: nothing is felt.
    """
    found, truth = (_impulse(whisker, p, speed, place) for p in (profile, FINEST))
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


@cache
def _impulse(whisker: Whisker, profile: Profile, speed: float, place: float) -> Floats:
    x = whisker.centreline(np.array([place * whisker.length]))[0, 0]
    low = whisker.centreline(np.linspace(0, whisker.length, 200))[:, 1].min()
    plate = Piece.of(trimesh.creation.box((20, PLATE_MM, 20)))
    samples = max(STRIKE_MS, round(8.0 / speed))
    way = np.array([x + 10, low - 2, 0.0]) + np.outer(np.arange(samples + 1), [0, speed, 0])
    force: Floats = alone(whisker, profile, plate).advance(way)[0][:, 0, :3]
    return force.sum(axis=0)


def slow_friction(whisker: Whisker, profile: Profile, speed: float) -> float:
    """Slide a peg slowly to and fro along a whisker, and compare the forces with faster ones.

    Args:
        speed: mm/s.

    Returns:
        95th percentile of the error of the force on the base, relative, over the way.
    """
    found, truth = (_slid(whisker, profile, v) for v in (speed, FAST_ENOUGH_MM_S))
    error = np.linalg.norm(found - truth, axis=1) / np.linalg.norm(truth, axis=1)
    return float(np.percentile(error, 95))


@cache
def _slid(whisker: Whisker, profile: Profile, speed: float) -> Floats:
    """(place, 3) force on the base at places along the way, N."""
    world = alone(whisker, profile, PEG)
    s = 0.6 * whisker.length
    x, y, _ = whisker.centreline(np.array([s]))[0]
    start = np.array([x, y + PEG_RADIUS_MM + float(whisker.radius(np.array([s]))[0]) + 0.02, 0.0])
    pressed = start - [0, 0.02 * whisker.length + 0.02, 0]
    corners = np.array(
        [pressed + np.array([d, 0, d / 2]) for d in (0.0, SLID_MM, -SLID_MM / 2, SLID_MM / 4)]
    )
    press = np.linspace(start, pressed, 51)
    world.advance(np.concatenate([press, np.tile(press[-1], (50, 1))]))
    places = []
    for begin, end in pairwise(corners):
        ms = round(np.linalg.norm(end - begin) / speed * 1e3)
        force = world.advance(np.linspace(begin, end, ms + 1))[0][:, 0, :3]
        at = np.linspace(0, ms, PLACES + 1)[1:].astype(int) - 1
        places.append(force[at])
    return np.concatenate(places)
