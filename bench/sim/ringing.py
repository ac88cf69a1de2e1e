"""Whiskers set free and let go, as the profiles step them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.rods.chains import chain_mass
from tactile_rt.sim_backend.rods.rod import make_rod
from tactile_rt.sim_backend.rods.world import RodWorld
from tactile_rt.sim_backend.world import SAMPLE_MS, Profile

Floats = NDArray[np.float64]

SMALL = 1e-3  # rad that all joints together are bent by: linear
PLANE = slice(1, None, 2)  # of the joints, those that bend in the whisker's plane
EXACT_LINKS = 60
RELEASE_MS = 30
FINE_STEPS = 50  # in a millisecond, over which the exact moment is averaged


def _alone(whisker: Whisker, profile: Profile) -> RodWorld:
    root = np.concatenate([np.zeros((1, 3)), whisker.orientation])[None]
    return RodWorld((whisker,), root, (), profile.links, round(SAMPLE_MS / profile.timestep_ms))


def rod_ring(whisker: Whisker, profile: Profile) -> tuple[float, float]:
    """Natural frequency (Hz) and damping ratio of the first mode, from samples of the base moment.

    Released from the shape of its first mode, a linear whisker obeys y'' = a y' + b y from sample
    to sample; a least-squares fit of a and b gives the two poles (Prony's method).
    """
    world = _alone(whisker, profile)
    (rod,) = world.rods
    chain = rod.chain
    mass = chain_mass(chain)[PLANE, PLANE]
    _, shapes = eigh(mass, np.diag(chain.stiffness[PLANE]))
    world.angles[PLANE] = shapes[:, -1] * SMALL / abs(shapes[:, -1]).sum()
    samples = max(8, round(1.5e3 / rod.resonance_hz))
    y = world.advance(np.zeros((samples + 1, 3)))[0][:, 0, 5]
    (a, b), *_ = np.linalg.lstsq(np.stack([y[1:-1], y[:-2]], axis=1), y[2:], rcond=None)
    poles = np.log(np.roots([1, -a, -b]).astype(complex)) / SAMPLE_MS
    omega = float(np.sqrt(abs(np.prod(poles))))
    return omega / (2 * np.pi) * 1e3, float(-poles.sum().real / (2 * omega))


def _bent(whisker: Whisker, links: int) -> tuple[Floats, Floats, Floats]:
    """Mass matrix, stiffness and angles (joint,) of a chain whose tip is pushed lightly along y."""
    # undamped: of its own mass
    chain = make_rod(replace(whisker, damping_ratio=0.0), links, 1).chain
    mass = chain_mass(chain)[PLANE, PLANE]
    stiffness = chain.stiffness[PLANE]
    heading = np.cumsum(np.arctan2(chain.turn[:, 1], chain.turn[:, 0]))
    x = np.concatenate([[0.0], np.cumsum(chain.length * np.cos(heading))])
    force = SMALL * float(whisker.bending_stiffness(np.zeros(1))[0]) / whisker.length**2 * 1e3
    return mass, stiffness, force * (x[-1] - x[1:-1]) / stiffness


def release_error(whisker: Whisker, profile: Profile) -> float:
    """RMS of the error of the base moment over its RMS, after a push on the tip has ended.

    The truth is the sum over all modes of a finer chain in closed form, damped in proportion to
    their stiffness; averaged over each millisecond, as samples are.
    """
    mass, stiffness, angles = _bent(whisker, EXACT_LINKS)
    squares, shapes = eigh(np.diag(stiffness), mass)
    omega = np.sqrt(squares)
    decay = whisker.damping_ratio * omega**2 / omega[0]
    swing = np.sqrt((omega**2 - decay**2).astype(complex))
    size = shapes.T @ mass @ angles
    t = (np.arange(RELEASE_MS * FINE_STEPS) + 0.5)[:, None] * (SAMPLE_MS / FINE_STEPS)
    # exp(-d t) (cos w t + d / w sin w t) and its rate, with w imaginary where it does not swing
    fast, slow = np.exp((1j * swing - decay) * t), np.exp((-1j * swing - decay) * t)
    share = 0.5 - 0.5j * decay / swing
    angle = (share * fast + (1 - share) * slow) * size
    rate = (share * (1j * swing - decay) * fast + (1 - share) * (-1j * swing - decay) * slow) * size
    beta = 2 * whisker.damping_ratio / omega[0]
    # The first joint carries, with its damper, what the clamp does but for half a small cell.
    truth = (stiffness[0] * ((angle + beta * rate) @ shapes[0])).real
    truth = truth.reshape(RELEASE_MS, FINE_STEPS).mean(axis=1)
    world = _alone(whisker, profile)
    world.angles[PLANE] = _bent(whisker, profile.links)[2]
    felt = world.advance(np.zeros((RELEASE_MS + 1, 3)))[0][:, 0, 5] * 1e6
    return float(np.sqrt(np.mean((felt - truth) ** 2) / np.mean(truth**2)))
