"""One whisker stepped through time beside a moving object.

A step is implicit in stiffness and damping (backward Euler in the joint angles) and in contact:

    (M + h C + h^2 K) v' = M v - h (K q + inertial forces) + J' impulses
    gap + h (J v' - velocity of the surfaces) >= 0, it or the impulse zero, Coulomb's law

for every place where a link is nearest to a piece of the object, within `NEAR_MM`, touching or not
(Moreau 1988; Stewart and Trinkle 1996). What overlaps all the same, because a tip flew further
than that, is moved out without being given a velocity. A step in which a node would move further
than `LEAP_MM` is done again in parts.
"""

import math
from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.chains import place
from tactile_rt.sim_backend.rods.compiled import compiled
from tactile_rt.sim_backend.rods.one_step import step
from tactile_rt.sim_backend.rods.touching import MOST_CONTACTS, NEAR_MM, find_near

__all__ = ["advance"]

A = Any
LEAP_MM = 0.1  # further no node moves in one step, or it is divided
MOST_PARTS = 8
WILD_MM, WILDEST_PARTS = 20.0, 64  # a leap so far is a step that failed: many more parts
SAMPLE_MS = 1.0
STILL = 1e-9  # rad and rad/ms: a whisker at rest that nothing is near need not be stepped


@compiled
def _advance(
    steps_per_sample: int,
    clamped: int,
    turn: A,
    length: A,
    inertia: A,
    stiffness: A,
    added: A,
    damping: A,
    friction: float,
    q: A,
    v: A,
    memory: A,
    last: A,
    roots: A,
    bases: A,
    seg_link: A,
    seg_ends: A,
    seg_radii: A,
    seg_arcs: A,
    corners: A,
    corner_at: A,
    faces: A,
    face_at: A,
    rounding: A,
    way: A,
    reach: A,
    soonest: A,
    known: A,
    planes: A,
    loads: A,
    contacts: A,
) -> int:
    """Step one whisker through some samples of 1 ms.

    Args:
        steps_per_sample: how many steps make a sample.
        clamped, turn, length, inertia: see `chains`.
        stiffness: (degree of freedom,) uN m / rad.
        added, damping: (degree of freedom, as many or more columns) mg mm^2 and uN m ms / rad that
            go with the stiffness, see `rod.make_rod`.
        friction: Coulomb's coefficient.
        q, v: (degree of freedom,) angles and their rates; carried on.
        memory: (1,) what the object and the whisker have travelled since `reach` began, mm; carried
            on.
        last: (link, 4) the contact force on each link, normal and tangential (mN), and its drag, to
            begin from; carried on.
        roots: (step + 1 or 1, 4, 3) base point and, in the rows after it, the frame of the first
            link at rest: at the beginning of each step; 1: the base stands still.
        bases: (sample or 1, 4, 3) see `chains.inertial_forces`; 1: it is not accelerated.
        seg_link, seg_ends, seg_radii: see `touching.find_near`.
        seg_arcs: (segment, 2) arc lengths of the ends, mm.
        corners, corner_at, faces, face_at, rounding: see `touching.find_near`.
        way: (sample + 1, 3) where the object is at the beginning of each sample and at the end of
            the last, mm; straight in between.
        reach, soonest, known, planes: see `touching.find_near`; carried on.
        loads: (sample, 6) zeros, filled: means of force (mN) and moment (uN m) on the base, in the
            world.
        contacts: (sample, 5) zeros, filled: share of the time in contact, mean normal force (mN),
            mean of normal force times arc length (uN m), and of a base that gives the mean turns
            about the element's y and z (rad).

    Returns:
        How many steps were computed; negative if the numbers are not finite any more.
    """
    links = len(length)
    n = 2 * (links - clamped)
    h = SAMPLE_MS / steps_per_sample
    still, quiet = len(roots) == 1, len(bases) == 1
    busy = _moves(q, v)
    if still and quiet and not busy:  # nothing comes near it in all this time
        whole = 0.0
        for sample in range(len(way) - 1):
            whole += _distance(way, sample)
        if soonest.min() - memory[0] - whole >= NEAR_MM:
            memory[0] += whole
            return 0
    wide = 3 * MOST_CONTACTS
    nodes, frames, axes = np.empty((links + 1, 3)), np.empty((links, 3, 3)), np.empty((n, 3))
    old = np.empty((links + 1, 3))
    mass, lower = np.zeros((n, n)), np.zeros((n, n))
    work3, work6 = np.empty((3, 3)), np.empty((links, 6))
    pushed, wrench, felt = np.zeros((links, 6)), np.zeros(6), np.zeros(2)
    total = np.empty(6)
    gaps, normals = np.empty(MOST_CONTACTS), np.empty((MOST_CONTACTS, 3))
    points, whose = np.empty((MOST_CONTACTS, 3)), np.empty((MOST_CONTACTS, 2))
    ends, seen = np.empty((len(seg_link), 2, 3)), np.empty((len(seg_link), 6))
    drag = np.zeros(MOST_CONTACTS)
    rows, reply = np.empty((wide, 3)), np.empty((wide, n))
    response, free = np.empty((wide, wide)), np.empty(max(wide, n))
    found, move = np.empty(wide), np.empty(n)
    q0, v0, surface, centre = np.empty(n), np.empty(n), np.empty(3), np.empty(3)
    done, factored = 0, 0.0  # for which step length the factor is
    placed = False
    for at in range((len(way) - 1) * steps_per_sample):
        sample, within = at // steps_per_sample, at % steps_per_sample
        moves = _distance(way, sample) / steps_per_sample
        for i in range(3):
            surface[i] = (way[sample + 1, i] - way[sample, i]) / SAMPLE_MS
        if within == 0:
            factored = 0.0
        if still and quiet and soonest.min() - memory[0] >= NEAR_MM and not _moves(q, v):
            memory[0] += moves
            q[:] = 0.0
            v[:] = 0.0
            placed = False
            continue
        root, base = roots[0 if still else at], bases[0 if quiet else sample]
        if not placed or not still:
            _root(root, nodes, frames)
            place(links, clamped, turn, length, q, nodes, frames, axes)
            placed = True
        parts, start = 1, memory[0]
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
                if soonest.min() - memory[0] < NEAR_MM:
                    count = find_near(
                        nodes, frames, seg_link, seg_ends, seg_radii, corners, corner_at, faces,
                        face_at, rounding, centre, reach, soonest, memory[0], known, planes, ends, seen,
                        gaps, normals, points, whose,
                    )  # fmt: skip
                step(
                    h / parts, int(parts == 1), clamped, turn, length, inertia, stiffness, added, damping, friction,
                    q, v, nodes, frames, axes, base, surface, count, gaps, normals, points, whose,
                    seg_link, h / parts != factored, mass, lower, work3, work6, pushed, felt, last, drag, rows, reply, response,
                    free, found, move, wrench,
                )  # fmt: skip
                factored = h / parts
                done += 1
                old[:] = nodes
                if still or part + 1 < parts:
                    _root(root, nodes, frames)
                else:
                    _root(roots[at + 1], nodes, frames)
                place(links, clamped, turn, length, q, nodes, frames, axes)
                moved = 0.0
                for b in range(links + 1):
                    away = 0.0
                    for i in range(3):
                        away += (nodes[b, i] - old[b, i]) ** 2
                    if not away <= moved:  # also where it is no number
                        moved = away
                moved = math.sqrt(moved)
                if not moved <= furthest:
                    furthest = moved
                memory[0] += moves / parts + 1.1 * moved
                for i in range(6):
                    total[i] += wrench[i]
                if count and felt[0] > 0.0:
                    touching += 1.0
                    force += felt[0]
                    s, t = int(whose[int(felt[1]), 0]), whose[int(felt[1]), 1]
                    lever += felt[0] * (seg_arcs[s, 0] * (1 - t) + seg_arcs[s, 1] * t)
            wild = not furthest < WILD_MM  # also where it is no number
            if wild and parts >= WILDEST_PARTS:
                return -done - 1
            if not wild and (furthest <= LEAP_MM or parts >= MOST_PARTS):
                break
            # again, in parts
            if wild:
                parts *= MOST_PARTS
                last[:] = 0.0
                reach[:] = -np.inf
                known[:] = -1
                planes[:, :, :3] = 0.0
                planes[:, :, 3] = np.inf
                planes[:, :, 4] = start
                soonest[:-1] = -np.inf
                memory[0] = start
            else:
                while parts < MOST_PARTS and furthest > LEAP_MM:
                    parts *= 2
                    furthest /= 2
                memory[0] += memory[0] - start  # and all the way back
            q[:] = q0
            v[:] = v0
            _root(root, nodes, frames)
            place(links, clamped, turn, length, q, nodes, frames, axes)
        weight = 1.0 / (parts * steps_per_sample)
        for i in range(6):
            loads[sample, i] -= total[i] * weight
        contacts[sample, 0] += touching * weight
        contacts[sample, 1] += force * weight
        contacts[sample, 2] += lever * weight
        if not clamped:
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
def _root(root: A, nodes: A, frames: A) -> None:
    for i in range(3):
        nodes[0, i] = root[0, i]
        for k in range(3):
            frames[0, i, k] = root[1 + i, k]


@compiled
def advance(
    steps: A,
    clamped: A,
    link_at: A,
    free_at: A,
    seg_at: A,
    turn: A,
    length: A,
    inertia: A,
    stiffness: A,
    added: A,
    damping: A,
    friction: A,
    q: A,
    v: A,
    memory: A,
    last: A,
    roots: A,
    bases: A,
    seg_link: A,
    seg_ends: A,
    seg_radii: A,
    seg_arcs: A,
    corners: A,
    corner_at: A,
    faces: A,
    face_at: A,
    rounding: A,
    way: A,
    reach: A,
    soonest: A,
    known: A,
    planes: A,
    loads: A,
    contacts: A,
) -> int:
    """Step whiskers, whose arrays stand one after the other, through some samples of 1 ms.

    Args:
        steps, clamped, friction: (whisker,) see `_advance`, as all that is not said here.
        link_at, free_at, seg_at: (whisker + 1,) where the links, degrees of freedom and segments of
            each whisker begin.
        roots: (whisker, step + 1 or 1, 4, 3).
        loads, contacts: (whisker, sample, 6) and (whisker, sample, 5).

    Returns:
        How many steps were computed, or -1.
    """
    done = 0
    for w in range(len(steps)):
        link, free, seg = (
            slice(link_at[w], link_at[w + 1]),
            slice(free_at[w], free_at[w + 1]),
            slice(seg_at[w], seg_at[w + 1]),
        )
        computed = _advance(
            steps[w], clamped[w], turn[link], length[link], inertia[link], stiffness[free],
            added[free], damping[free], friction[w], q[free], v[free], memory[w], last[link],
            roots[w], bases, seg_link[seg], seg_ends[seg], seg_radii[seg], seg_arcs[seg], corners,
            corner_at, faces, face_at, rounding, way, reach[seg], soonest[w], known[seg], planes[seg],
            loads[w], contacts[w],
        )  # fmt: skip
        if computed < 0:
            return -1
        done += computed
    return done
