"""One step of one whisker: mechanics, contacts, and the load on its base."""

import math
from typing import Any

from tactile_rt.sim_backend.rods.chains import (
    factor,
    inertial_forces,
    mass_matrix,
    solve_back,
    solve_forth,
)
from tactile_rt.sim_backend.rods.compiled import compiled
from tactile_rt.sim_backend.rods.coulomb import impulses

__all__ = ["step"]

A = Any
OUT_SWEEPS = 30


@compiled
def _directions(normal: A, frame: A, rows: A) -> None:
    """Fill rows (3, 3) with a normal and two tangents, the first along the link if it can be."""
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


@compiled
def step(
    h: float,
    heavier: int,
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
    nodes: A,
    frames: A,
    axes: A,
    base: A,
    surface: A,
    count: int,
    gaps: A,
    normals: A,
    points: A,
    whose: A,
    seg_link: A,
    fresh: bool,
    mass: A,
    lower: A,
    work3: A,
    work6: A,
    pushed: A,
    felt: A,
    last: A,
    drag: A,
    rows: A,
    reply: A,
    response: A,
    free: A,
    found: A,
    move: A,
    wrench: A,
) -> None:
    """One step from where the chain stands: q, v and the wrench (6,) on the base are filled.

    Args:
        base: see `chains.inertial_forces`.
        surface: (3,) velocity of the object, mm/ms.
        count, gaps, normals, points, whose: what is near, see `touching.find_near`.
        fresh: whether to fill `mass` and its factor `lower`, which otherwise are those of an
            earlier step of the same length.
        felt: (2,) filled: the normal forces (mN), and the contact with the largest.
        last: (link, 4) see `advance`.
    """
    links = len(length)
    n = 2 * (links - clamped)
    pushed[:] = 0.0
    for i in range(n):
        move[i] = 0.0
    inertial_forces(
        links, clamped, inertia, nodes, frames, axes, v, move, base, pushed, work6, free, wrench
    )
    if fresh:
        # The added mass is that of the whisker at rest: bent far, the sum may be less than nothing.
        for share in range(heavier, -1, -1):
            mass_matrix(links, clamped, inertia, nodes, frames, axes, work3, mass)
            for i in range(n):
                for j in range(i + 1):
                    mass[i, j] += share * added[i, j]
                    lower[i, j] = mass[i, j] + h * damping[i, j]
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
            link = int(seg_link[int(whose[c, 0])])
            _directions(normals[c], frames[link], rows[3 * c : 3 * c + 3])
            reply[3 * c : 3 * c + 3, :n] = 0.0
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
                    reply[i, k] = j0 * rows[i, 0] + j1 * rows[i, 1] + j2 * rows[i, 2]
            # what the base's own motion gives the point, less the object's
            r0, r1, r2 = (
                points[c, 0] - nodes[0, 0],
                points[c, 1] - nodes[0, 1],
                points[c, 2] - nodes[0, 2],
            )
            u0 = base[0, 0] + base[1, 1] * r2 - base[1, 2] * r1 - surface[0]
            u1 = base[0, 1] + base[1, 2] * r0 - base[1, 0] * r2 - surface[1]
            u2 = base[0, 2] + base[1, 0] * r1 - base[1, 1] * r0 - surface[2]
            for i in range(3 * c, 3 * c + 3):
                solve_forth(lower, n, reply[i])
                s = rows[i, 0] * u0 + rows[i, 1] * u1 + rows[i, 2] * u2
                for k in range(n):
                    s += reply[i, k] * move[k]
                free[i] = s
            free[3 * c] += max(gaps[c], 0.0) / h
        for i in range(3 * count):
            for j in range(i + 1):
                s = 0.0
                for k in range(n):
                    s += reply[i, k] * reply[j, k]
                response[i, j], response[j, i] = s, s
        for c in range(count):
            # begin from the last step's, of the contact on the same link
            link = int(seg_link[int(whose[c, 0])])
            drag[c] = last[link, 3]
            for i in range(3):
                found[3 * c + i] = last[link, i] * h
                last[link, i] = 0.0
        impulses(count, response, free, friction, drag, found)
        most = 0
        for c in range(count):
            felt[0] += found[3 * c] / h
            if found[3 * c] > found[3 * most]:
                most = c
            link = int(seg_link[int(whose[c, 0])])
            if found[3 * c] >= last[link, 0] * h:
                last[link, 3] = drag[c]
                for i in range(3):
                    last[link, i] = found[3 * c + i] / h
            f0, f1, f2 = 0.0, 0.0, 0.0
            for i in range(3 * c, 3 * c + 3):
                if found[i] != 0.0:
                    f0 += rows[i, 0] * found[i] / h
                    f1 += rows[i, 1] * found[i] / h
                    f2 += rows[i, 2] * found[i] / h
                    for k in range(n):
                        move[k] += reply[i, k] * found[i]
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
    inertial_forces(
        links, clamped, inertia, nodes, frames, axes, v, move, base, pushed, work6, free, wrench
    )
    for i in range(n):
        q[i] += h * v[i]
    deep = False
    for c in range(count):
        deep |= gaps[c] < 0.0
    if deep:
        _out(
            h,
            count,
            gaps,
            reply,
            response,
            rows,
            found,
            v,
            lower,
            n,
            points,
            nodes,
            base,
            surface,
            free,
            q,
        )


@compiled
def _out(
    h: float,
    count: int,
    gaps: A,
    reply: A,
    response: A,
    rows: A,
    found: A,
    v: A,
    lower: A,
    n: int,
    points: A,
    nodes: A,
    base: A,
    surface: A,
    free: A,
    q: A,
) -> None:
    """Move out what overlaps, by the least that does it, without giving it a velocity."""
    # free: how far each contact will still be inside after the step, mm
    for c in range(count):
        i = 3 * c
        r0 = points[c, 0] - nodes[0, 0]
        r1 = points[c, 1] - nodes[0, 1]
        r2 = points[c, 2] - nodes[0, 2]
        u0 = base[0, 0] + base[1, 1] * r2 - base[1, 2] * r1 - surface[0]
        u1 = base[0, 1] + base[1, 2] * r0 - base[1, 0] * r2 - surface[1]
        u2 = base[0, 2] + base[1, 0] * r1 - base[1, 1] * r0 - surface[2]
        s = rows[i, 0] * u0 + rows[i, 1] * u1 + rows[i, 2] * u2
        # J v = (L^-1 J')' L' v
        for k in range(n):
            x = 0.0
            for j in range(k, n):
                x += lower[j, k] * v[j]
            s += reply[i, k] * x
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
            free[k] += reply[3 * c, k] * found[c]
    solve_back(lower, n, free)
    for k in range(n):
        q[k] += free[k]
