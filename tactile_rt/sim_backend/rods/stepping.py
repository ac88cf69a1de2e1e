"""One whisker stepped through time beside a moving object, on a base that may turn.

A step is implicit in stiffness and damping (backward Euler in the joint angles) and in contact:

    (M + h C + h^2 K) v' = M v - h (K q + inertial forces) + J' impulses
    gap + h (J v' - velocity of the surfaces) >= 0, it or the impulse zero, Coulomb's law

for every place where a link is nearest to a piece of the object, within `NEAR_MM`, touching or not
(Moreau 1988; Stewart and Trinkle 1996). What overlaps all the same, because a tip flew further
than that, is moved out without being given a velocity. A step in which a node would move further
than `LEAP_MM` is done again in parts.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.sim_backend.rods.chains import Chain, Pose, place
from tactile_rt.sim_backend.rods.compiled import compiled
from tactile_rt.sim_backend.rods.one_step import scratch, step
from tactile_rt.sim_backend.rods.touching import (
    MOST_CONTACTS,
    NEAR_MM,
    Contacts,
    Object,
    Seen,
    Segments,
    find_near,
    forget,
)

__all__ = ["RodState", "RowBounds", "advance"]

A = Any
LEAP_MM = 0.1  # further no node moves in one step, or it is divided
MOST_PARTS = 8
WILD_MM, WILDEST_PARTS = 20.0, 64  # a leap so far is a step that failed: many more parts
SAMPLE_MS = 1.0
STILL = 1e-9  # rad and rad/ms: a whisker at rest that nothing is near need not be stepped


class RodState(NamedTuple):
    """What a whisker carries on from step to step.

    Attributes:
        q, v: (degree of freedom,) angles and their rates, rad and rad/ms.
        last: (link, 4) the contact force on each link, normal and tangential (mN), and its drag, to
            begin from.
    """

    q: A
    v: A
    last: A


class RowBounds(NamedTuple):
    """Where each whisker's rows begin, and where the last's end: (whisker + 1,) each."""

    links: A
    joints: A
    segments: A


@compiled
def advance(
    steps: A,
    rows: RowBounds,
    chains: Chain,
    segments: Segments,
    thing: Object,
    state: RodState,
    seen: Seen,
    roots: A,
    bases: A,
    way: A,
    loads: A,
    contacts: A,
) -> int:
    """Step whiskers through some samples of 1 ms.

    Args:
        steps: (whisker,) how many steps make a sample.
        state, seen: see there; carried on. `travelled` and `soonest` are a row for each whisker.
        roots: (whisker, sample or 1, 4, 3) base point and, in the rows after it, the frame of the
            first link at rest, at the beginning of each sample; 1: it does not turn.
        bases: (whisker or 1, sample or 1, 4, 3) see `chains.inertial_forces`; 1: the same of all.
            During a sample a frame turns with its base's angular velocity.
        way: (sample + 1, 3) where the object is at the beginning of each sample and at the end of
            the last, mm; straight in between.
        loads: (whisker, sample, 6) zeros, filled: means of force (mN) and moment (uN m) on the
            base, in the world.
        contacts: (whisker, sample, 5) zeros, filled: share of the time in contact, mean normal
            force (mN), mean of normal force times arc length (uN m), and of a base that gives the
            mean turns about the element's y and z (rad).

    Returns:
        How many steps were computed; negative if the numbers are not finite any more.
    """
    done = 0
    for w in range(len(steps)):
        link = slice(rows.links[w], rows.links[w + 1])
        joint = slice(rows.joints[w], rows.joints[w + 1])
        segment = slice(rows.segments[w], rows.segments[w + 1])
        computed = _advance(
            steps[w],
            Chain(
                chains.clamped[w],
                chains.turn[link],
                chains.length[link],
                chains.inertia[link],
                chains.stiffness[joint],
                chains.added[joint],
                chains.damping[joint],
                chains.friction[w],
            ),
            Segments(
                segments.link[segment],
                segments.ends[segment],
                segments.bows[segment],
                segments.radii[segment],
                segments.arcs[segment],
            ),
            thing,
            RodState(state.q[joint], state.v[joint], state.last[link]),
            Seen(
                seen.travelled[w],
                seen.reach[segment],
                seen.soonest[w],
                seen.known[segment],
                seen.planes[segment],
            ),
            roots[w],
            bases[w if len(bases) > 1 else 0],
            way,
            loads[w],
            contacts[w],
        )
        if computed < 0:
            return -1
        done += computed
    return done


@compiled
def _advance(
    steps_per_sample: int,
    chain: Chain,
    segments: Segments,
    thing: Object,
    state: RodState,
    seen: Seen,
    root: A,
    bases: A,
    way: A,
    loads: A,
    contacts: A,
) -> int:
    """`advance` of one whisker."""
    q, v, last = state
    travelled, soonest = seen.travelled, seen.soonest
    links, n = len(chain.length), len(q)
    h = SAMPLE_MS / steps_per_sample
    quiet = not bases.any()
    reach = chain.length.sum()
    if quiet and not _moves(q, v):  # perhaps nothing comes near it in all this time
        whole = 0.0
        for sample in range(len(way) - 1):
            whole += _distance(way, sample)
        if soonest.min() - travelled[0] - whole >= NEAR_MM:
            travelled[0] += whole
            return 0
    pose = Pose(np.empty((links + 1, 3)), np.empty((links, 3, 3)), np.empty((n, 3)))
    near = Contacts(
        np.empty(MOST_CONTACTS),
        np.empty((MOST_CONTACTS, 3)),
        np.empty((MOST_CONTACTS, 3)),
        np.zeros(MOST_CONTACTS, np.int64),
        np.empty(MOST_CONTACTS),
    )
    room, old, total = scratch(links, n), np.empty((links + 1, 3)), np.empty(6)
    ends, now = np.empty((len(segments.link), 2, 3)), np.empty((len(segments.link), 6))
    q0, v0, surface, centre = np.empty(n), np.empty(n), np.empty(3), np.empty(3)
    done, made = 0, 0.0  # for which length of a step the mass matrix is
    here = root[0].copy()
    placed = False
    for at in range((len(way) - 1) * steps_per_sample):
        sample, within = at // steps_per_sample, at % steps_per_sample
        moves = _distance(way, sample) / steps_per_sample
        for i in range(3):
            surface[i] = (way[sample + 1, i] - way[sample, i]) / SAMPLE_MS
        if within == 0:
            made = 0.0
        if quiet and soonest.min() - travelled[0] >= NEAR_MM and not _moves(q, v):
            travelled[0] += moves
            q[:] = 0.0
            v[:] = 0.0
            placed = False
            continue
        base = bases[sample if len(bases) > 1 else 0]
        began = root[sample if len(root) > 1 else 0]
        if not placed:
            _turned(began, base, h * within, here)
            _place(here, chain, q, pose)
            placed = True
        parts, start = 1, travelled[0]
        swing = 0.0  # how far the base takes the tip
        for i in range(3):
            swing += base[1, i] ** 2
        swing = math.sqrt(swing) * reach * h
        if soonest.min() - start < NEAR_MM + moves + 1.1 * swing:
            while parts < MOST_PARTS and swing > parts * LEAP_MM:
                parts *= 2
        q0[:] = q
        v0[:] = v
        while True:
            furthest = 0.0
            total[:] = 0.0
            touching, force, lever = 0.0, 0.0, 0.0
            for part in range(parts):
                for i in range(3):
                    centre[i] = way[sample, i] + surface[i] * (h * (within + part / parts))
                count = 0
                if soonest.min() - travelled[0] < NEAR_MM:
                    count = find_near(pose, segments, thing, centre, seen, ends, now, near)
                # Matched masses are those for whole steps; what leaps is better off with its own.
                step(
                    h / parts,
                    h / parts != made,
                    parts == 1,
                    chain,
                    q,
                    v,
                    pose,
                    base,
                    surface,
                    count,
                    near,
                    segments.link,
                    last,
                    room,
                )
                made = h / parts
                done += 1
                old[:] = pose.nodes
                _turned(began, base, h * (within + (part + 1) / parts), here)
                _place(here, chain, q, pose)
                moved = _furthest(old, pose.nodes)
                if not moved <= furthest:  # also where it is no number
                    furthest = moved
                travelled[0] += moves / parts + 1.1 * moved
                for i in range(6):
                    total[i] += room.wrench[i]
                if count and room.felt[0] > 0.0:
                    most = int(room.felt[1])
                    arcs, t = segments.arcs[near.segments[most]], near.places[most]
                    touching += 1.0
                    force += room.felt[0]
                    lever += room.felt[0] * (arcs[0] * (1 - t) + arcs[1] * t)
            wild = not furthest < WILD_MM  # also where it is no number
            if wild and parts >= WILDEST_PARTS:
                return -done - 1
            if not wild and (furthest <= LEAP_MM or parts >= MOST_PARTS):
                break
            # what swings through air leaps as far as it likes
            if not wild and swing > 0.0 and soonest.min() - travelled[0] >= NEAR_MM:
                break
            # again, in parts
            if wild:
                parts *= MOST_PARTS
                travelled[0] = start
                last[:] = 0.0
                forget(seen)
            else:
                while parts < MOST_PARTS and furthest > LEAP_MM:
                    parts *= 2
                    furthest /= 2
                travelled[0] += travelled[0] - start  # and all the way back
            q[:] = q0
            v[:] = v0
            _turned(began, base, h * within, here)
            _place(here, chain, q, pose)
        weight = 1.0 / (parts * steps_per_sample)
        for i in range(6):
            loads[sample, i] -= total[i] * weight
        contacts[sample, 0] += touching * weight
        contacts[sample, 1] += force * weight
        contacts[sample, 2] += lever * weight
        if not chain.clamped:
            contacts[sample, 3] += q[0] / steps_per_sample
            contacts[sample, 4] += q[1] / steps_per_sample
    return done


@compiled
def _moves(q: A, v: A) -> bool:
    for i in range(len(q)):
        if not (abs(q[i]) <= STILL and abs(v[i]) <= STILL):
            return True
    return False


@compiled
def _distance(way: A, sample: int) -> float:
    square = 0.0
    for i in range(3):
        square += (way[sample + 1, i] - way[sample, i]) ** 2
    return math.sqrt(square)


@compiled
def _furthest(old: A, new: A) -> float:
    """How far the node went that went furthest; no number where one is none."""
    furthest = 0.0
    for b in range(len(old)):
        square = 0.0
        for i in range(3):
            square += (new[b, i] - old[b, i]) ** 2
        if not square <= furthest:
            furthest = square
    return math.sqrt(furthest)


@compiled
def _turned(root: A, base: A, t: float, here: A) -> None:
    """Fill in a base's frame so long after a sample began (Rodrigues' rotation)."""
    x, y, z = base[1, 0] * t, base[1, 1] * t, base[1, 2] * t
    angle = math.sqrt(x * x + y * y + z * z)
    here[:] = root
    if angle == 0.0:
        return
    x, y, z = x / angle, y / angle, z / angle
    c, s = math.cos(angle), math.sin(angle)
    for k in range(3):
        u, v, w = root[1, k], root[2, k], root[3, k]
        onto = (x * u + y * v + z * w) * (1.0 - c)
        here[1, k] = u * c + (y * w - z * v) * s + x * onto
        here[2, k] = v * c + (z * u - x * w) * s + y * onto
        here[3, k] = w * c + (x * v - y * u) * s + z * onto


@compiled
def _place(root: A, chain: Chain, q: A, pose: Pose) -> None:
    for i in range(3):
        pose.nodes[0, i] = root[0, i]
        for k in range(3):
            pose.frames[0, i, k] = root[1 + i, k]
    place(chain, q, pose)
