"""Time stepping of a whisker beside a moving object, on a base that may rotate.

A step is implicit in stiffness and damping (backward Euler in the joint angles) and in contact:

    (M + h C + h^2 K) v' = M v - h (K q + inertial forces) + J' impulses
    gap + h (J v' - velocity of the surfaces) >= 0, it or the impulse zero, Coulomb's law

for every place where a link is nearest to a piece of the object, within `NEAR_MM`, touching or not
(Moreau 1988; Stewart and Trinkle 1996). If a tip flew further than that and overlaps, it is moved
out without changing its velocity. A step in which a node moves further than `LEAP_MM` near the
object is repeated in parts, and one in which the object moves far is divided from the start;
masses and damping are matched to each length of a step, see `rod.match_ringing`. Near its rest and
away from the object, a whisker advances by a whole sample at once, see `resting`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.sim_backend.rods.chains import Chain, Pose, place_at
from tactile_rt.sim_backend.rods.compiled import compile_cached
from tactile_rt.sim_backend.rods.one_step import scratch, step
from tactile_rt.sim_backend.rods.resting import LITTLE, move_on
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

A = Any
LEAP_MM = 0.1  # a step in which a node moves further is divided
MOST_PARTS = 8
HASTE_MM = 0.16  # over the number of links: an object's largest motion in a step near a whisker
MOST_IN_HASTE = 128
WILD_MM, WILDEST_PARTS = 20.0, 512  # a step with so long a leap has failed: many more parts
SAMPLE_MS = 1.0
BENT = 0.01  # of the whisker's length: motion of nodes after which its mass matrix is recomputed
LOOK_MM = 2.0  # range of the search if it may spare steps
STILL = 1e-9  # rad and rad/ms: below, a whisker with nothing near is not stepped


class RodState(NamedTuple):
    """The state of a whisker between steps, and its equilibrium under its weight.

    Attributes:
        q, v: (degree of freedom,) joint angles and their rates, rad and rad/ms.
        last: (link, 6) the last contact force on each link, normal and tangential (mN), and its
            drag, as initial values; the deflection of the sticking contact, see `one_step`, mm.
        rest: (degree of freedom,) angles at rest, bent by its weight, rad.
        weight: (whisker, 6) force (mN) and moment (uN m) that hold it at rest.
        answers: The linear response near rest over a sample, see `resting.linearise`.
    """

    q: A
    v: A
    last: A
    rest: A
    weight: A
    answers: A


class RowBounds(NamedTuple):
    """Row offsets of each whisker in concatenated arrays, with the end: (whisker + 1,) each."""

    links: A
    joints: A
    segments: A
    answers: A


@compile_cached
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
    quiet: bool,
    gravity: A,
    way: A,
    loads: A,
    contacts: A,
) -> int:
    """Simulate whiskers through samples of 1 ms; return the number of computed steps.

    Args:
        steps: (whisker,) number of steps in a sample.
        state, seen: updated. `travelled` and `soonest` have a row for each whisker.
        roots: (whisker, sample or 1, 4, 3) base point and, in the rows after it, the frame of the
            first link at rest, at the beginning of each sample; 1 if it does not rotate.
        bases: (whisker or 1, sample or 1, 4, 3) see `chains.inertial_forces`; 1 if equal for all.
            During a sample a frame rotates with its base's angular velocity.
        quiet: whether the bases stand still.
        gravity: (3,) mm/ms^2; `bases` contains it as the opposite acceleration.
        way: (sample + 1, 3) positions of the object at the beginning of each sample and at the end
            of the last, mm; it moves straight in between.
        loads: (whisker, sample, 6) zeros, filled: means of force (mN) and moment (uN m) on the
            base, in the world.
        contacts: (whisker, sample, 6) zeros, filled: share of the time in contact, mean normal
            force (mN), mean of normal force times arc length (uN m), mean angles of a compliant
            base about the element's y and z (rad), and the depth of overlap with the object, mm.

    Returns:
        The number of computed steps; negative if a step still fails in `WILDEST_PARTS` parts.
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
            RodState(
                state.q[joint],
                state.v[joint],
                state.last[link],
                state.rest[joint],
                state.weight[w : w + 1],
                state.answers[rows.answers[w] : rows.answers[w + 1]],
            ),
            Seen(
                seen.travelled[w],
                seen.reach[segment],
                seen.soonest[w],
                seen.known[segment],
                seen.planes[segment],
            ),
            roots[w],
            bases[w if len(bases) > 1 else 0],
            quiet,
            gravity,
            way,
            loads[w],
            contacts[w],
        )
        if computed < 0:
            return -1
        done += computed
    return done


@compile_cached
def _advance(
    steps_per_sample: int,
    chain: Chain,
    segments: Segments,
    thing: Object,
    state: RodState,
    seen: Seen,
    root: A,
    bases: A,
    quiet: bool,
    gravity: A,
    way: A,
    loads: A,
    contacts: A,
) -> int:
    """Simulate one whisker; arguments and result are those of `advance`."""
    q, v, last, rest, weight, answers = state
    travelled, soonest = seen.travelled, seen.soonest
    links, n = len(chain.length), len(q)
    h = SAMPLE_MS / steps_per_sample
    reach = chain.length.sum()
    if quiet and not _is_moving(q, v, rest):  # skip all samples if nothing comes near
        whole = 0.0
        for sample in range(len(way) - 1):
            whole += _measure_distance(way, sample)
        if soonest.min() - travelled[0] - whole >= NEAR_MM:
            travelled[0] += whole
            for i in range(6):
                loads[:, i] -= weight[0, i]
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
    last0 = np.empty((links, 6))
    since = 0.0
    done, made = 0, 0.0  # steps so far; length of the step that the mass matrix was computed for
    here = root[0].copy()
    placed, little = False, np.empty(2 * n + 3)
    at = -1
    while at < (len(way) - 1) * steps_per_sample - 1:
        at += 1
        sample, within = at // steps_per_sample, at % steps_per_sample
        moves = _measure_distance(way, sample) / steps_per_sample
        for i in range(3):
            surface[i] = (way[sample + 1, i] - way[sample, i]) / SAMPLE_MS
        if within == 0:
            made = 0.0
        if quiet and soonest.min() - travelled[0] >= NEAR_MM + moves and not _is_moving(q, v, rest):
            travelled[0] += moves
            q[:] = rest
            v[:] = 0.0
            for i in range(6):
                loads[sample, i] -= weight[0, i] / steps_per_sample
            placed = False
            continue
        base = bases[sample if len(bases) > 1 else 0]
        began = root[sample if len(root) > 1 else 0]
        if within == 0 and len(answers) and (quiet or not (base[1].any() or base[3].any())):
            clear = NEAR_MM + moves * steps_per_sample + 4.0 * LITTLE * reach
            if NEAR_MM <= soonest.min() - travelled[0] < clear:  # look wider: bounds last longer
                _rotate_base(began, base, 0.0, here)
                place_at(here, chain, q, pose)
                find_near(pose, segments, thing, way[sample], LOOK_MM, seen, ends, now, near)
            free = soonest.min() - travelled[0] - NEAR_MM - moves * steps_per_sample
            felt = loads[sample], contacts[sample]
            gone = move_on(free / reach, state, began, base[2] + gravity, little, felt)
            if gone >= 0.0:
                travelled[0] += moves * steps_per_sample + 1.1 * reach * gone
                at += steps_per_sample - 1
                placed = False
                continue
        if not placed:
            _rotate_base(began, base, h * within, here)
            place_at(here, chain, q, pose)
            placed = True
        parts, start = 1, travelled[0]
        swing = 0.0  # largest motion of the tip by the base's rotation
        for i in range(3):
            swing += base[1, i] ** 2
        swing = math.sqrt(swing) * reach * h
        if soonest.min() - start < NEAR_MM + moves + 1.1 * swing:
            while parts < MOST_PARTS and swing > parts * LEAP_MM:
                parts *= 2
            while parts < MOST_IN_HASTE and moves * links > parts * HASTE_MM:
                parts *= 2
        q0[:] = q
        v0[:] = v
        last0[:] = last
        while True:
            furthest = 0.0
            total[:] = 0.0
            touching, force, lever, deepest = 0.0, 0.0, 0.0, 0.0
            level = 0
            while 1 << level < parts and level + 1 < chain.added.shape[1]:
                level += 1
            for part in range(parts):
                for i in range(3):
                    centre[i] = way[sample, i] + surface[i] * (h * (within + part / parts))
                count = 0
                if soonest.min() - travelled[0] < NEAR_MM:
                    count = find_near(pose, segments, thing, centre, NEAR_MM, seen, ends, now, near)
                fresh = h / parts != made or since > BENT * reach
                if fresh:
                    since = 0.0
                step(
                    h / parts,
                    fresh,
                    level,
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
                _rotate_base(began, base, h * (within + (part + 1) / parts), here)
                place_at(here, chain, q, pose)
                moved = _find_largest_move(old, pose.nodes)
                since += moved
                if not moved <= furthest:  # also if it is not a number
                    furthest = moved
                travelled[0] += moves / parts + 1.1 * moved
                for i in range(6):
                    total[i] += room.wrench[i]
                for c in range(count):
                    deepest = max(deepest, -near.gaps[c])
                if count and room.felt[0] > 0.0:
                    most = int(room.felt[1])
                    arcs, t = segments.arcs[near.segments[most]], near.places[most]
                    touching += 1.0
                    force += room.felt[0]
                    lever += room.felt[0] * (arcs[0] * (1 - t) + arcs[1] * t)
            wild = not furthest < WILD_MM  # also if it is not a number
            if wild and parts >= WILDEST_PARTS:
                return -done - 1
            if not wild and (furthest <= LEAP_MM or parts >= MOST_PARTS):
                break
            # away from the object a leap of any length is fine
            if not wild and soonest.min() - travelled[0] >= NEAR_MM:
                break
            # repeat the step in parts
            if wild:
                parts *= 8
                travelled[0] = start
                last[:] = 0.0
                forget(seen)
            else:
                while parts < MOST_PARTS and furthest > LEAP_MM:
                    parts *= 2
                    furthest /= 2
                travelled[0] += travelled[0] - start  # the way back counts, too
            q[:] = q0
            v[:] = v0
            if not wild:
                last[:] = last0
            _rotate_base(began, base, h * within, here)
            place_at(here, chain, q, pose)
        share = 1.0 / (parts * steps_per_sample)
        for i in range(6):
            loads[sample, i] -= total[i] * share
        contacts[sample, 0] += touching * share
        contacts[sample, 1] += force * share
        contacts[sample, 2] += lever * share
        contacts[sample, 5] = max(contacts[sample, 5], deepest)
        if not chain.clamped:
            contacts[sample, 3] += q[0] / steps_per_sample
            contacts[sample, 4] += q[1] / steps_per_sample
    return done


@compile_cached
def _is_moving(q: A, v: A, rest: A) -> bool:
    for i in range(len(q)):
        if not (abs(q[i] - rest[i]) <= STILL and abs(v[i]) <= STILL):
            return True
    return False


@compile_cached
def _measure_distance(way: A, sample: int) -> float:
    square = 0.0
    for i in range(3):
        square += (way[sample + 1, i] - way[sample, i]) ** 2
    return math.sqrt(square)


@compile_cached
def _find_largest_move(old: A, new: A) -> float:
    """Return the largest distance that a node moved, mm; NaN if the tip's is."""
    furthest = 0.0
    for b in range(len(old)):
        square = 0.0
        for i in range(3):
            square += (new[b, i] - old[b, i]) ** 2
        if not square <= furthest:
            furthest = square
    return math.sqrt(furthest)


@compile_cached
def _rotate_base(root: A, base: A, t: float, here: A) -> None:
    """Compute a base's frame at `t` ms after the sample's start (Rodrigues' rotation)."""
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
