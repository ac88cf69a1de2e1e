"""A whisker as a chain of links, with the parameters that `stepping` needs."""

import cmath
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tactile_rt.sim_backend.arrays.whiskers import (
    Floats,
    Whisker,
    joint_stiffness,
    link_inertia,
    link_nodes,
    rotation,
)
from tactile_rt.sim_backend.rods.chains import Chain, chain_mass
from tactile_rt.sim_backend.rods.touching import Segments

SAG_MM = 7e-4  # largest distance of a segment's chord from the resting curve
FINEST = 8  # largest factor by which the step is divided so that a whisker rings correctly
SAMPLE_MS = 1.0
FINE_LINKS, TRUE_MODES = 40, 6  # a chain as accurate as the whisker itself, in so many modes
LEVELS = 8  # lengths of a step: the whole, and each half of the one before, see `stepping`
SMOOTH_HZ = 200.0  # faster whiskers take proportionally shorter steps
HEARD_HZ = 500.0  # samples at 1 kHz cannot represent resonances above


@dataclass(frozen=True)
class Rod:
    """A whisker cut into links, with a time step at which it rings correctly.

    Attributes:
        resonance_hz: The first resonance of the whisker on its mount, Hz.
        wanted_ratio: The target damping ratio of the first mode, including the mount's damping.
        damping_ratio: The damping ratio of the first mode as simulated.
        to_element: The (3, 3) rotation from the frame of the first link to that of the element.
    """

    steps_per_sample: int
    resonance_hz: float
    wanted_ratio: float
    damping_ratio: float
    chain: Chain
    segments: Segments
    to_element: Floats


def make_rod(whisker: Whisker, links: int, steps_per_sample: int) -> Rod:
    """Cut a whisker into cells, and choose a time step at which it rings correctly.

    A step that is long against a period makes a mode slower and damps it more. Both are corrected
    for every mode, see `match_ringing`, as far as the step allows. If it does not for the first
    mode, the step is halved, but only for whiskers whose ringing the samples can represent.

    Args:
        links: number of cells; the chain has one more link.
    """
    s = link_nodes(whisker, links)
    nodes = whisker.centreline(s)
    chain, damping, heading = _cut_chain(whisker, links)
    mass = chain_mass(chain)
    slow, shapes = _find_modes(mass, chain.stiffness)
    ratios = damping @ shapes**2 / (2 * slow)  # of each mode
    # The chain's modes must be as fast as those of the whisker itself.
    omegas = slow.copy()
    fine, _, _ = _cut_chain(whisker, FINE_LINKS)
    known, _ = _find_modes(chain_mass(fine), fine.stiffness)
    omegas[:TRUE_MODES] = known[:TRUE_MODES]
    first = int(omegas.argmin())
    ratios *= omegas / slow * (slow[first] / omegas[first])
    softer = (slow / omegas) ** 2
    steps, resonance_hz = steps_per_sample, float(omegas[first] / (2 * np.pi) * 1e3)
    found = [match_ringing(w, z, SAMPLE_MS / steps) for w, z in zip(omegas, ratios, strict=True)]
    while (
        (found[first][1] < 0 or resonance_hz * steps_per_sample > SMOOTH_HZ * steps)
        and resonance_hz < HEARD_HZ
        and steps < FINEST * steps_per_sample
    ):
        steps *= 2
        found = [
            match_ringing(w, z, SAMPLE_MS / steps) for w, z in zip(omegas, ratios, strict=True)
        ]
    ratio = float(ratios[first])
    if found[first][1] < 0:  # over-damped even without damping: the ratio of backward Euler alone
        turn = omegas[first] * SAMPLE_MS / steps
        decay = math.log1p(turn**2) / 2
        ratio = decay / math.hypot(decay, math.atan(turn))
    # Correct each mode of the whisker at rest, for every length of a step.
    onto, heavy, damped = mass @ shapes, [], []
    for level in range(LEVELS):
        h = SAMPLE_MS / steps / 2**level
        found = [match_ringing(w, z, h) for w, z in zip(omegas, ratios, strict=True)]
        heavier = np.array([m if beta >= 0 else 1.0 for m, beta in found]) * softer
        drags = np.array([max(beta, 0.0) for _, beta in found]) * slow**2
        heavy.append((onto * (heavier - 1)) @ onto.T)
        damped.append((onto * drags) @ onto.T)
    # A clamped link cannot move out of the way: the object passes through it.
    free = range(chain.clamped, links + 1)
    pieces = [_cut_segments(whisker, i, s, nodes, heading[i]) for i in free]
    return Rod(
        steps_per_sample=steps,
        resonance_hz=resonance_hz,
        wanted_ratio=float(ratios[first]),
        damping_ratio=ratio,
        chain=chain._replace(added=np.stack(heavy, axis=1), damping=np.stack(damped, axis=1)),
        segments=Segments(
            np.repeat(np.array(free), [len(p[0]) for p in pieces]),
            *(np.concatenate(each) for each in zip(*pieces, strict=True)),
        ),
        to_element=rotation("z", -heading[0]),
    )


def _cut_chain(whisker: Whisker, links: int) -> tuple[Chain, Floats, Floats]:
    """Cut a whisker into a chain of links, jointed at the middle of `links` cells.

    Returns:
        The chain without added masses and damping, the stiffness-proportional damping of each
        joint (uN m ms / rad), and the links' headings at rest (rad).
    """
    s = link_nodes(whisker, links)
    chords = np.diff(whisker.centreline(s), axis=0)
    headings = np.arctan2(chords[:, 1], chords[:, 0])
    turns = np.diff(headings, prepend=headings[0])
    cell = whisker.length / links
    k = [joint_stiffness(whisker, i * cell, (i + 1) * cell) for i in range(links)]
    none = np.zeros((0, 0, 0))
    chain = Chain(
        clamped=1,
        turn=np.stack([np.cos(turns), np.sin(turns)], axis=1),
        length=np.linalg.norm(chords, axis=1),
        inertia=np.array([link_inertia(whisker, a, b) for a, b in pairwise(s)]),
        stiffness=np.repeat(k, 2),
        added=none,
        damping=none,
        friction=whisker.friction,
    )
    omegas, _ = _find_modes(chain_mass(chain), chain.stiffness)
    damping = 2 * whisker.damping_ratio / omegas.min() * chain.stiffness
    if whisker.mount_stiffness:
        stiffness = np.concatenate([[whisker.mount_stiffness * 1e6] * 2, chain.stiffness])
        damping = np.concatenate([[whisker.mount_damping * 1e9] * 2, damping])
        chain = chain._replace(clamped=0, stiffness=stiffness)
    return chain, damping, headings


def _find_modes(mass: Floats, stiffness: Floats) -> tuple[Floats, Floats]:
    """Find the vibration modes of a chain at rest, in and out of plane.

    Returns:
        Angular frequencies (mode,), rad/ms, slowest first in each plane; shapes (joint, mode) of
        unit mass.
    """
    omegas, shapes = np.empty(len(stiffness)), np.zeros((len(stiffness), len(stiffness)))
    for plane in (slice(0, None, 2), slice(1, None, 2)):
        root = np.sqrt(stiffness[plane])
        squares, own = np.linalg.eigh(mass[plane, plane] / np.outer(root, root))
        omegas[plane] = 1 / np.sqrt(np.maximum(squares[::-1], 1e-300))
        shapes[plane, plane] = own[:, ::-1] / root[:, None] * omegas[plane]
    return omegas, shapes


def match_ringing(omega: float, ratio: float, h: float) -> tuple[float, float]:
    """Compute mass factor and damping that make backward Euler ring a mode exactly.

    The step x' = x + h v', m (v' - v) = -h (k x' + beta k v') multiplies the mode by two numbers.
    With more mass and less damping than the mode has, they are exp(h lambda), its poles lambda.

    Returns:
        The factor of the mass, and beta (ms), negative if the step alone damps more than `ratio`.
    """
    root = cmath.sqrt(ratio * ratio - 1)
    first, second = -omega / (ratio + root), -omega * (ratio + root)  # the poles
    left = cmath.exp(first * h), cmath.exp(second * h)
    gone = ((1 - left[0]) * (1 - left[1])).real
    if abs(first * h) < 1e-3:  # a series, to avoid cancellation
        gone = (first * second * h * h * (1 + (first + second) * h / 2)).real
    product = (left[0] * left[1]).real
    beta = h * ((left[0] + left[1]).real - 2 * product) / gone
    return (omega * h) ** 2 * product / gone, beta


def _cut_segments(
    whisker: Whisker, link: int, s: Floats, nodes: Floats, heading: float
) -> tuple[Floats, ...]:
    """Cut a link into contact segments: ends, bows, radii and arcs, as in `Segments`."""
    longest = math.sqrt(8 * SAG_MM / max(2 * abs(whisker.curvature), 1e-12))
    count = max(1, math.ceil((s[link + 1] - s[link]) / longest))
    at = np.linspace(s[link], s[link + 1], count + 1)
    turn = rotation("z", -heading).T
    places = (whisker.centreline(at) - nodes[link]) @ turn
    middles = (whisker.centreline((at[:-1] + at[1:]) / 2) - nodes[link]) @ turn

    def pairs(x: Floats) -> Floats:
        return np.ascontiguousarray(np.stack([x[:-1], x[1:]], axis=1))

    bows = middles - (places[:-1] + places[1:]) / 2
    return pairs(places), bows, pairs(whisker.radius(at)), pairs(at)
