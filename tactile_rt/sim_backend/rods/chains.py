"""The mechanics of a chain of links: its pose, its mass matrix, its inertial forces.

In mm, mg and ms, like `world`. Link b is from node b to node b + 1. Its joint is a hinge about its
resting y axis, followed by a hinge about its own z axis, so its degrees of freedom are
2 (b - clamped) and the next; the first link has none if the base is clamped.

Featherstone, Rigid Body Dynamics Algorithms (2008): composite bodies for the mass matrix, Newton
and Euler's equations from link to link for the forces.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.sim_backend.rods.compiled import compile_cached

A = Any  # a contiguous array of float64: numba infers the types of arguments


class Chain(NamedTuple):
    """The mechanical parameters of one whisker, or of many, their rows concatenated.

    Attributes:
        clamped: The number of links without a joint: 1, or 0 on a compliant base.
        turn: (link, 2) cosine and sine of the resting angle from the previous link, about z.
        length: (link,) lengths of the links, mm.
        inertia: (link, 4) mass (mg), centroid from the link's node (mm), axial and transverse
            inertia (mg mm^2).
        stiffness: (degree of freedom,) stiffnesses of the joints, uN m / rad.
        added, damping: (degree of freedom, level, as many or more columns) added mass (mg mm^2) and
            damping (uN m ms / rad) for each length of a step, see `rod.make_rod`.
        friction: Coulomb's coefficient of friction of the surface.
    """

    clamped: Any
    turn: A
    length: A
    inertia: A
    stiffness: A
    added: A
    damping: A
    friction: Any


class Pose(NamedTuple):
    """The pose of a chain in the world.

    Attributes:
        nodes: (link + 1, 3) ends of the links, mm.
        frames: (link, 3, 3) frames of the links, x along the link, in columns.
        axes: (degree of freedom, 3) axes of the joints, of unit length.
    """

    nodes: A
    frames: A
    axes: A


@compile_cached
def place(chain: Chain, q: A, pose: Pose) -> None:
    """Fill a chain's pose from joint angles and from its first node and first frame.

    Args:
        q: (degree of freedom,) joint angles, rad.
    """
    clamped, turn, length = chain.clamped, chain.turn, chain.length
    nodes, frames, axes = pose
    for b in range(len(length)):
        if b > 0:
            c, s = turn[b, 0], turn[b, 1]
            for i in range(3):
                x, y = frames[b - 1, i, 0], frames[b - 1, i, 1]
                frames[b, i, 0] = x * c + y * s
                frames[b, i, 1] = y * c - x * s
                frames[b, i, 2] = frames[b - 1, i, 2]
        if b >= clamped:
            j = 2 * (b - clamped)
            cy, sy = math.cos(q[j]), math.sin(q[j])
            cz, sz = math.cos(q[j + 1]), math.sin(q[j + 1])
            for i in range(3):
                x, y, z = frames[b, i, 0], frames[b, i, 1], frames[b, i, 2]
                axes[j, i] = y
                x, z = x * cy - z * sy, x * sy + z * cy
                axes[j + 1, i] = z
                frames[b, i, 0], frames[b, i, 1] = x * cz + y * sz, y * cz - x * sz
                frames[b, i, 2] = z
        for i in range(3):
            nodes[b + 1, i] = nodes[b, i] + frames[b, i, 0] * length[b]


@compile_cached
def place_at(root: A, chain: Chain, q: A, pose: Pose) -> None:
    """Fill the pose of a chain on a base, `root` (4, 3): point, then frame."""
    for i in range(3):
        pose.nodes[0, i] = root[0, i]
        for k in range(3):
            pose.frames[0, i, k] = root[1 + i, k]
    place(chain, q, pose)


@compile_cached
def mass_matrix(chain: Chain, pose: Pose, work: A, matrix: A) -> None:
    """Compute the lower triangle of a chain's joint-space mass matrix, mg mm^2.

    Args:
        work: (3, 3) scratch.
        matrix: (degree of freedom, degree of freedom) filled.
    """
    clamped, inertia = chain.clamped, chain.inertia
    nodes, frames, axes = pose
    mass, h0, h1, h2 = 0.0, 0.0, 0.0, 0.0  # of the links from here on: mass and first moments
    work[:] = 0.0  # their inertia about the world's origin
    for b in range(len(inertia) - 1, clamped - 1, -1):
        m, across = inertia[b, 0], inertia[b, 3]
        x0, x1, x2 = frames[b, 0, 0], frames[b, 1, 0], frames[b, 2, 0]
        r0 = nodes[b, 0] + x0 * inertia[b, 1]
        r1 = nodes[b, 1] + x1 * inertia[b, 1]
        r2 = nodes[b, 2] + x2 * inertia[b, 1]
        mass += m
        h0 += m * r0
        h1 += m * r1
        h2 += m * r2
        along = inertia[b, 2] - across
        work[0, 0] += m * (r1 * r1 + r2 * r2) + across + along * x0 * x0
        work[1, 1] += m * (r0 * r0 + r2 * r2) + across + along * x1 * x1
        work[2, 2] += m * (r0 * r0 + r1 * r1) + across + along * x2 * x2
        work[0, 1] += along * x0 * x1 - m * r0 * r1
        work[0, 2] += along * x0 * x2 - m * r0 * r2
        work[1, 2] += along * x1 * x2 - m * r1 * r2
        p0, p1, p2 = nodes[b, 0], nodes[b, 1], nodes[b, 2]
        d0, d1, d2 = h0 - mass * p0, h1 - mass * p1, h2 - mass * p2
        for k in range(2 * (b - clamped), 2 * (b - clamped) + 2):
            a0, a1, a2 = axes[k, 0], axes[k, 1], axes[k, 2]
            # Momentum of all links that rotate with this joint at unit speed, and its moment.
            l0, l1, l2 = a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0
            v0, v1, v2 = a2 * p1 - a1 * p2, a0 * p2 - a2 * p0, a1 * p0 - a0 * p1
            m0 = work[0, 0] * a0 + work[0, 1] * a1 + work[0, 2] * a2 + h1 * v2 - h2 * v1
            m1 = work[0, 1] * a0 + work[1, 1] * a1 + work[1, 2] * a2 + h2 * v0 - h0 * v2
            m2 = work[0, 2] * a0 + work[1, 2] * a1 + work[2, 2] * a2 + h0 * v1 - h1 * v0
            for c in range(clamped, b + 1):
                q0, q1, q2 = nodes[c, 0], nodes[c, 1], nodes[c, 2]
                n0 = m0 - q1 * l2 + q2 * l1
                n1 = m1 - q2 * l0 + q0 * l2
                n2 = m2 - q0 * l1 + q1 * l0
                j = 2 * (c - clamped)
                matrix[k, j] = n0 * axes[j, 0] + n1 * axes[j, 1] + n2 * axes[j, 2]
                if j + 1 <= k:
                    matrix[k, j + 1] = (
                        n0 * axes[j + 1, 0] + n1 * axes[j + 1, 1] + n2 * axes[j + 1, 2]
                    )


@compile_cached
def inertial_forces(
    chain: Chain, pose: Pose, v: A, a: A, base: A, pushed: A, work: A, torques: A, wrench: A
) -> None:
    """Compute a motion's joint torques (inverse dynamics), less those of external forces.

    Args:
        v, a: (degree of freedom,) rad/ms and rad/ms^2.
        base: (4, 3) the base's velocity (not used), angular velocity, acceleration, angular
            acceleration.
        pushed: (link, 6) force (mN) and moment about the world's origin (uN m) on each link.
        work: (link, 6) scratch.
        torques: (degree of freedom,) filled: about each joint's axis, uN m.
        wrench: (6,) filled: force (mN) and moment (uN m) that the base exerts, about its point.
    """
    clamped, inertia = chain.clamped, chain.inertia
    nodes, frames, axes = pose
    links = len(inertia)
    w0, w1, w2 = base[1, 0], base[1, 1], base[1, 2]  # angular velocity
    t0, t1, t2 = base[3, 0], base[3, 1], base[3, 2]  # angular acceleration
    s0, s1, s2 = base[2, 0], base[2, 1], base[2, 2]  # acceleration of the link's node
    for b in range(links):
        if b >= clamped:
            for k in range(2 * (b - clamped), 2 * (b - clamped) + 2):
                x0, x1, x2 = axes[k, 0], axes[k, 1], axes[k, 2]
                t0 += x0 * a[k] + (w1 * x2 - w2 * x1) * v[k]
                t1 += x1 * a[k] + (w2 * x0 - w0 * x2) * v[k]
                t2 += x2 * a[k] + (w0 * x1 - w1 * x0) * v[k]
                w0 += x0 * v[k]
                w1 += x1 * v[k]
                w2 += x2 * v[k]
        x0, x1, x2 = frames[b, 0, 0], frames[b, 1, 0], frames[b, 2, 0]
        m, at, across = inertia[b, 0], inertia[b, 1], inertia[b, 3]
        along = inertia[b, 2] - across
        # Acceleration per mm along the link: tangential and centripetal.
        u0, u1, u2 = w1 * x2 - w2 * x1, w2 * x0 - w0 * x2, w0 * x1 - w1 * x0
        c0 = t1 * x2 - t2 * x1 + w1 * u2 - w2 * u1
        c1 = t2 * x0 - t0 * x2 + w2 * u0 - w0 * u2
        c2 = t0 * x1 - t1 * x0 + w0 * u1 - w1 * u0
        f0, f1, f2 = m * (s0 + at * c0), m * (s1 + at * c1), m * (s2 + at * c2)
        wx = w0 * x0 + w1 * x1 + w2 * x2
        tx = t0 * x0 + t1 * x1 + t2 * x2
        l0 = across * w0 + along * wx * x0
        l1 = across * w1 + along * wx * x1
        l2 = across * w2 + along * wx * x2
        r0, r1, r2 = nodes[b, 0] + at * x0, nodes[b, 1] + at * x1, nodes[b, 2] + at * x2
        work[b, 0], work[b, 1], work[b, 2] = f0 - pushed[b, 0], f1 - pushed[b, 1], f2 - pushed[b, 2]
        work[b, 3] = (
            across * t0 + along * tx * x0 + w1 * l2 - w2 * l1 + r1 * f2 - r2 * f1 - pushed[b, 3]
        )
        work[b, 4] = (
            across * t1 + along * tx * x1 + w2 * l0 - w0 * l2 + r2 * f0 - r0 * f2 - pushed[b, 4]
        )
        work[b, 5] = (
            across * t2 + along * tx * x2 + w0 * l1 - w1 * l0 + r0 * f1 - r1 * f0 - pushed[b, 5]
        )
        if b + 1 < links:
            # The next node; a link's length is the distance of its nodes.
            n = math.sqrt(
                (nodes[b + 1, 0] - nodes[b, 0]) ** 2
                + (nodes[b + 1, 1] - nodes[b, 1]) ** 2
                + (nodes[b + 1, 2] - nodes[b, 2]) ** 2
            )
            s0 += n * c0
            s1 += n * c1
            s2 += n * c2
    for b in range(links - 1, -1, -1):
        if b + 1 < links:
            for i in range(6):
                work[b, i] += work[b + 1, i]
        p0, p1, p2 = nodes[b, 0], nodes[b, 1], nodes[b, 2]
        f0, f1, f2 = work[b, 0], work[b, 1], work[b, 2]
        m0 = work[b, 3] - p1 * f2 + p2 * f1
        m1 = work[b, 4] - p2 * f0 + p0 * f2
        m2 = work[b, 5] - p0 * f1 + p1 * f0
        if b >= clamped:
            for k in range(2 * (b - clamped), 2 * (b - clamped) + 2):
                torques[k] = m0 * axes[k, 0] + m1 * axes[k, 1] + m2 * axes[k, 2]
        if b == 0:
            wrench[0], wrench[1], wrench[2] = f0, f1, f2
            wrench[3], wrench[4], wrench[5] = m0, m1, m2


@compile_cached
def factor(matrix: A, n: int) -> bool:
    """Compute the Cholesky factor of the first n rows, in place, from the lower triangle.

    Returns:
        False if the matrix is not positive definite.
    """
    for i in range(n):
        for j in range(i):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = s / matrix[j, j]
        s = matrix[i, i]
        for k in range(i):
            s -= matrix[i, k] * matrix[i, k]
        if not s > 0.0:
            return False
        matrix[i, i] = math.sqrt(s)
    return True


@compile_cached
def solve_forth(lower: A, n: int, x: A) -> None:
    """Solve L y = x for y, which replaces x."""
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= lower[i, k] * x[k]
        x[i] = s / lower[i, i]


@compile_cached
def solve_many_forth(lower: A, n: int, count: int, x: A) -> None:
    """Solve L y = x for y, which replaces x: `count` columns at once."""
    for i in range(n):
        for k in range(i):
            for c in range(count):
                x[i, c] -= lower[i, k] * x[k, c]
        for c in range(count):
            x[i, c] /= lower[i, i]


@compile_cached
def solve_back(lower: A, n: int, x: A) -> None:
    """Solve L' y = x for y, which replaces x."""
    for i in range(n - 1, -1, -1):
        x[i] /= lower[i, i]
        s = x[i]
        for k in range(i):
            x[k] -= lower[i, k] * s


def chain_mass(chain: Chain) -> A:
    """Compute the full joint-space mass matrix of a chain at rest, mg mm^2."""
    links, n = len(chain.length), 2 * (len(chain.length) - chain.clamped)
    pose = Pose(np.zeros((links + 1, 3)), np.zeros((links, 3, 3)), np.zeros((n, 3)))
    pose.frames[0], matrix = np.eye(3), np.zeros((n, n))
    place(chain, np.zeros(n), pose)
    mass_matrix(chain, pose, np.empty((3, 3)), matrix)
    return np.tril(matrix) + np.tril(matrix, -1).T
