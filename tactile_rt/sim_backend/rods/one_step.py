"""A time step of one whisker: mechanics, contacts with dry friction, and the load on its base."""

import math
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.sim_backend.rods.chains import (
    Chain,
    Pose,
    factor,
    inertial_forces,
    mass_matrix,
    solve_back,
    solve_forth,
    solve_many_forth,
)
from tactile_rt.sim_backend.rods.compiled import compile_cached
from tactile_rt.sim_backend.rods.friction import impulses
from tactile_rt.sim_backend.rods.touching import MOST_CONTACTS, Contacts

A = Any
OUT_SWEEPS = 30
GIVES_MM = 1e-4  # deflection of a sticking contact before it slides


@compile_cached
def _fill_directions(normal: A, frame: A, rows: A) -> None:
    """Fill `rows` with the normal and two tangents, the first along the link if possible."""
    for axis in range(2):
        x0, x1, x2 = frame[0, axis], frame[1, axis], frame[2, axis]
        onto = x0 * normal[0] + x1 * normal[1] + x2 * normal[2]
        x0, x1, x2 = x0 - onto * normal[0], x1 - onto * normal[1], x2 - onto * normal[2]
        size = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        if size > 0.5:
            break
    for i in range(3):
        rows[0, i] = normal[i]
    rows[1, 0], rows[1, 1], rows[1, 2] = x0 / size, x1 / size, x2 / size
    rows[2, 0] = normal[1] * rows[1, 2] - normal[2] * rows[1, 1]
    rows[2, 1] = normal[2] * rows[1, 0] - normal[0] * rows[1, 2]
    rows[2, 2] = normal[0] * rows[1, 1] - normal[1] * rows[1, 0]


class Scratch(NamedTuple):
    """Work arrays of a time step; only those read after the step are documented.

    Attributes:
        mass, lower: The mass matrix and the Cholesky factor of the system, of the last step for
            which they were computed.
        wrench: (6,) force of the base (mN) and moment about it (uN m) in the last step.
        felt: (2,) the sum of the normal forces (mN), and the number of the contact with the
            largest, in the last step.
    """

    mass: A
    lower: A
    wrench: A
    felt: A
    cube: A
    forces: A
    pushed: A
    drag: A
    rows: A
    reply: A
    response: A
    free: A
    found: A
    move: A


@compile_cached
def scratch(links: int, n: int) -> Scratch:
    """Allocate `Scratch` for a whisker of `links` links and `n` degrees of freedom."""
    wide = 3 * MOST_CONTACTS
    return Scratch(
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros(6),
        np.zeros(2),
        np.empty((3, 3)),
        np.empty((links, 6)),
        np.zeros((links, 6)),
        np.zeros(MOST_CONTACTS),
        np.empty((wide, 3)),
        np.empty((n, wide)),
        np.empty((wide, wide)),
        np.empty(max(wide, n)),
        np.empty(wide),
        np.empty(n),
    )


@compile_cached
def step(
    h: float,
    fresh: bool,
    level: int,
    chain: Chain,
    q: A,
    v: A,
    pose: Pose,
    base: A,
    surface: A,
    count: int,
    near: Contacts,
    link_of: A,
    last: A,
    room: Scratch,
) -> None:
    """Advance a chain by one time step: q, v and `room` are updated.

    Args:
        h: length of the step, ms.
        fresh: whether to compute mass matrix and factor anew; else those of an earlier step of the
            same length are used.
        level: how many times the usual step is halved, which selects added masses and damping.
        q, v: (degree of freedom,) joint angles and their rates, rad and rad/ms.
        surface: (3,) velocity of the object, mm/ms.
        last: (link, 6) see `stepping.RodState`; updated.
    """
    clamped, stiffness, friction = chain.clamped, chain.stiffness, chain.friction
    nodes, frames, axes = pose
    gaps, normals, points, segments, _ = near
    mass, lower, wrench, felt = room.mass, room.lower, room.wrench, room.felt
    pushed, drag, found, move = room.pushed, room.drag, room.found, room.move
    rows, reply, response, free = room.rows, room.reply, room.response, room.free
    n = len(stiffness)
    pushed[:] = 0.0
    for i in range(n):
        move[i] = 0.0
    inertial_forces(chain, pose, v, move, base, pushed, room.forces, free, wrench)
    if fresh:
        # The added mass is that at rest: if bent far, the sum may not be positive definite.
        for share in range(1, -1, -1):
            mass_matrix(chain, pose, room.cube, mass)
            for i in range(n):
                for j in range(i + 1):
                    mass[i, j] += share * chain.added[i, level, j]
                    lower[i, j] = mass[i, j] + h * chain.damping[i, level, j]
                lower[i, i] += h * h * stiffness[i]
            if factor(lower, n):
                break
        for i in range(n):
            for j in range(i):
                mass[j, i] = mass[i, j]
    for i in range(n):
        s = -h * (stiffness[i] * q[i] + free[i])
        for j in range(n):
            s += mass[i, j] * v[j]
        move[i] = s
    solve_forth(lower, n, move)
    felt[0] = 0.0
    if count:
        for c in range(count):
            link = link_of[segments[c]]
            _fill_directions(normals[c], frames[link], rows[3 * c : 3 * c + 3])
            reply[:, 3 * c : 3 * c + 3] = 0.0
            for k in range(2 * (link + 1 - clamped)):
                b = clamped + k // 2
                r0, r1, r2 = (
                    points[c, 0] - nodes[b, 0],
                    points[c, 1] - nodes[b, 1],
                    points[c, 2] - nodes[b, 2],
                )
                j0 = axes[k, 1] * r2 - axes[k, 2] * r1
                j1 = axes[k, 2] * r0 - axes[k, 0] * r2
                j2 = axes[k, 0] * r1 - axes[k, 1] * r0
                for i in range(3 * c, 3 * c + 3):
                    reply[k, i] = j0 * rows[i, 0] + j1 * rows[i, 1] + j2 * rows[i, 2]
        solve_many_forth(lower, n, 3 * count, reply)
        for c in range(count):
            # velocity of the point that moves with the base, relative to the object
            r0, r1, r2 = (
                points[c, 0] - nodes[0, 0],
                points[c, 1] - nodes[0, 1],
                points[c, 2] - nodes[0, 2],
            )
            u0 = base[0, 0] + base[1, 1] * r2 - base[1, 2] * r1 - surface[0]
            u1 = base[0, 1] + base[1, 2] * r0 - base[1, 0] * r2 - surface[1]
            u2 = base[0, 2] + base[1, 0] * r1 - base[1, 1] * r0 - surface[2]
            for i in range(3 * c, 3 * c + 3):
                s = rows[i, 0] * u0 + rows[i, 1] * u1 + rows[i, 2] * u2
                for k in range(n):
                    s += reply[k, i] * move[k]
                free[i] = s
            free[3 * c] += max(gaps[c], 0.0) / h
            # Deflection that a sticking contact has already, see `GIVES_MM`.
            link = link_of[segments[c]]
            free[3 * c + 1] += last[link, 4] / h
            free[3 * c + 2] += last[link, 5] / h
        for i in range(3 * count):
            for j in range(3 * count):
                response[i, j] = 0.0
            for k in range(n):
                for j in range(3 * count):
                    response[i, j] += reply[k, i] * reply[k, j]
        for c in range(count):
            # start from the last step's contact on the same link
            link = link_of[segments[c]]
            drag[c] = last[link, 3]
            for i in range(3):
                found[3 * c + i] = last[link, i] * h
                last[link, i] = 0.0
        impulses(count, response, free, friction, drag, found)
        most = 0
        for c in range(count):
            link = link_of[segments[c]]
            last[link, 4], last[link, 5] = 0.0, 0.0
        for c in range(count):
            felt[0] += found[3 * c] / h
            if found[3 * c] > found[3 * most]:
                most = c
            link = link_of[segments[c]]
            if found[3 * c] >= last[link, 0] * h:
                last[link, 3] = drag[c]
                for i in range(3):
                    last[link, i] = found[3 * c + i] / h
                if found[3 * c] > 0.0:
                    s1, s2 = free[3 * c + 1], free[3 * c + 2]
                    for j in range(3 * count):
                        s1 += response[3 * c + 1, j] * found[j]
                        s2 += response[3 * c + 2, j] * found[j]
                    size = h * math.sqrt(s1 * s1 + s2 * s2)
                    given = h if size <= GIVES_MM else h * GIVES_MM / size
                    last[link, 4], last[link, 5] = s1 * given, s2 * given
            f0, f1, f2 = 0.0, 0.0, 0.0
            for i in range(3 * c, 3 * c + 3):
                if found[i] != 0.0:
                    f0 += rows[i, 0] * found[i] / h
                    f1 += rows[i, 1] * found[i] / h
                    f2 += rows[i, 2] * found[i] / h
                    for k in range(n):
                        move[k] += reply[k, i] * found[i]
            pushed[link, 0] += f0
            pushed[link, 1] += f1
            pushed[link, 2] += f2
            pushed[link, 3] += points[c, 1] * f2 - points[c, 2] * f1
            pushed[link, 4] += points[c, 2] * f0 - points[c, 0] * f2
            pushed[link, 5] += points[c, 0] * f1 - points[c, 1] * f0
        felt[1] = most
    solve_back(lower, n, move)
    for i in range(n):
        v[i], move[i] = move[i], (move[i] - v[i]) / h  # the new velocity, and the acceleration
    inertial_forces(chain, pose, v, move, base, pushed, room.forces, free, wrench)
    for i in range(n):
        q[i] += h * v[i]
    deep = False
    for c in range(count):
        deep |= gaps[c] < 0.0
    if deep:
        _push_out(h, count, base, surface, q, v, pose, near, room)


@compile_cached
def _push_out(
    h: float,
    count: int,
    base: A,
    surface: A,
    q: A,
    v: A,
    pose: Pose,
    near: Contacts,
    room: Scratch,
) -> None:
    """Move a whisker out of overlaps by the smallest displacement, without changing velocities."""
    n = len(q)
    gaps, points, nodes = near.gaps, near.points, pose.nodes
    lower, rows, reply, response = room.lower, room.rows, room.reply, room.response
    free, found, turned = room.free, room.found, room.move
    for k in range(n):  # J v = (L^-1 J')' L' v
        turned[k] = 0.0
        for j in range(k, n):
            turned[k] += lower[j, k] * v[j]
    # free: the gap of each contact after the step, mm; negative if still overlapping
    for c in range(count):
        i = 3 * c
        r0 = points[c, 0] - nodes[0, 0]
        r1 = points[c, 1] - nodes[0, 1]
        r2 = points[c, 2] - nodes[0, 2]
        u0 = base[0, 0] + base[1, 1] * r2 - base[1, 2] * r1 - surface[0]
        u1 = base[0, 1] + base[1, 2] * r0 - base[1, 0] * r2 - surface[1]
        u2 = base[0, 2] + base[1, 0] * r1 - base[1, 1] * r0 - surface[2]
        s = rows[i, 0] * u0 + rows[i, 1] * u1 + rows[i, 2] * u2
        for k in range(n):
            s += reply[k, i] * turned[k]
        free[c] = gaps[c] + h * s
        found[c] = 0.0
    for _ in range(OUT_SWEEPS):
        change = 0.0
        for c in range(count):
            s = free[c]
            for d in range(count):
                s += response[3 * c, 3 * d] * found[d]
            new = max(0.0, found[c] - s / response[3 * c, 3 * c])
            change = max(change, abs(new - found[c]) * response[3 * c, 3 * c])
            found[c] = new
        if change < 1e-7:
            break
    for k in range(n):
        free[k] = 0.0
    for c in range(count):
        for k in range(n):
            free[k] += reply[k, 3 * c] * found[c]
    solve_back(lower, n, free)
    for k in range(n):
        q[k] += free[k]
