"""A whisker's equilibrium under its weight, and its linearised free motion near it."""

from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.chains import (
    Chain,
    Pose,
    factor,
    inertial_forces,
    place_at,
    solve_back,
    solve_forth,
)
from tactile_rt.sim_backend.rods.compiled import compile_cached
from tactile_rt.sim_backend.rods.one_step import scratch, step
from tactile_rt.sim_backend.rods.touching import Contacts

A = Any
SHARES, MOST_TRIES = 4, 20  # load steps of the weight, and Newton iterations in each
SETTLED, NUDGE = 1e-12, 1e-6  # tolerance, and step of finite differences, rad
LITTLE = 0.005  # rad, sum over all joints: the limit of the linear range


@compile_cached
def settle(chain: Chain, root: A, gravity: A, q: A, weight: A, nodes: A) -> bool:
    """Find the joint angles at which a whisker rests under its weight, by Newton's method.

    Args:
        root: (4, 3) see `stepping.advance`.
        gravity: (3,) mm/ms^2.
        q: (degree of freedom,) rad, filled.
        weight: (6,) filled: see `RodState`.
        nodes: (2, link + 1, 3) filled: ends of the links without weight and with it, mm.

    Returns:
        False without a solution: the whisker is too soft to carry its weight.
    """
    links, n = len(chain.length), len(q)
    pose = Pose(np.empty((links + 1, 3)), np.empty((links, 3, 3)), np.empty((n, 3)))
    work, none = np.empty((links, 6)), np.zeros((links, 6))
    still, base = np.zeros(n), np.zeros((4, 3))
    torques, moved, hessian = np.empty(n), np.empty(n), np.empty((n, n))
    place_at(root, chain, q, pose)
    nodes[0] = pose.nodes
    off = 1.0
    for share in range(1, SHARES + 1):
        for i in range(3):
            base[2, i] = -gravity[i] * share / SHARES
        for _ in range(MOST_TRIES):
            place_at(root, chain, q, pose)
            inertial_forces(chain, pose, still, still, base, none, work, torques, weight)
            off = 0.0
            for i in range(n):
                torques[i] += chain.stiffness[i] * q[i]
                off = max(off, abs(torques[i] / chain.stiffness[i]))
            if off < SETTLED:
                break
            for j in range(n):
                q[j] += NUDGE
                place_at(root, chain, q, pose)
                inertial_forces(chain, pose, still, still, base, none, work, moved, weight)
                q[j] -= NUDGE
                for i in range(n):
                    bend = chain.stiffness[i] * (q[i] + NUDGE * (i == j))
                    hessian[i, j] = (moved[i] + bend - torques[i]) / NUDGE
            if not factor(hessian, n):
                return False
            solve_forth(hessian, n, torques)
            solve_back(hessian, n, torques)
            for i in range(n):
                q[i] -= torques[i]
    nodes[1] = pose.nodes
    return off < SETTLED


@compile_cached
def linearise(steps: int, chain: Chain, gravity: A, rest: A, answers: A) -> None:
    """Compute the matrix that advances a whisker near rest by a sample of 1 ms.

    Args:
        steps: time steps in a sample.
        gravity: (3,) in the frame of the first link, mm/ms^2.
        rest: (degree of freedom,) see `settle`, rad.
        answers: (2 degree of freedom + 6 or 8, 2 degree of freedom + 3) filled. Rows (outputs):
            angles relative to rest and their rates after the sample, mean force and moment of the
            base (mN and uN m) and, on a compliant base, its two mean rotations. Columns (inputs):
            angles relative to rest, rates, and acceleration of the base, in that frame.
    """
    links, n = len(chain.length), len(rest)
    pose = Pose(np.empty((links + 1, 3)), np.empty((links, 3, 3)), np.empty((n, 3)))
    none = Contacts(
        np.empty(1), np.empty((1, 3)), np.empty((1, 3)), np.zeros(1, np.int64), np.empty(1)
    )
    on, last, room = np.zeros(1, np.int64), np.zeros((links, 6)), scratch(links, n)
    root, surface = np.zeros((4, 3)), np.zeros(3)
    for i in range(3):
        root[1 + i, i] = 1.0
    q, v, base, found = np.empty(n), np.empty(n), np.zeros((4, 3)), np.empty(len(answers))
    for column in range(2 * n + 3):
        for side in (-1.0, 1.0):
            q[:] = rest
            v[:] = 0.0
            base[2] = -gravity
            if column < n:
                q[column] += side * NUDGE
            elif column < 2 * n:
                v[column - n] += side * NUDGE
            else:
                base[2, column - 2 * n] += side * NUDGE
            found[:] = 0.0
            for at in range(steps):
                place_at(root, chain, q, pose)
                step(
                    1.0 / steps,
                    at == 0,
                    0,
                    chain,
                    q,
                    v,
                    pose,
                    base,
                    surface,
                    0,
                    none,
                    on,
                    last,
                    room,
                )
                for i in range(6):
                    found[2 * n + i] += room.wrench[i] / steps
                for i in range(len(answers) - 2 * n - 6):
                    found[2 * n + 6 + i] += q[i] / steps
            found[:n] = q
            found[n : 2 * n] = v
            for i in range(len(answers)):
                if side < 0.0:
                    answers[i, column] = -found[i]
                else:
                    answers[i, column] = (answers[i, column] + found[i]) / (2 * NUDGE)


@compile_cached
def move_on(free: float, state: A, root: A, shaken: A, x: A, felt: A) -> float:
    """Advance a whisker near rest by a whole sample, if no object is near.

    Args:
        free: object-free distance around the whisker, divided by the whisker's length.
        state: see `stepping.RodState`; angles and rates are updated.
        root: (4, 3) see `stepping.advance`.
        shaken: (3,) acceleration of the base, mm/ms^2.
        x: (2 degree of freedom + 3,) scratch.
        felt: (6,) loads and (6,) contacts of the sample, filled: see `stepping.advance`.

    Returns:
        The sum of the joints' rotations, rad; negative if not advanced: too bent or an object near.
    """
    q, v, rest, answers = state.q, state.v, state.rest, state.answers
    load, contact = felt
    n = len(q)
    bent = 0.0
    for i in range(n):
        x[i], x[n + i] = q[i] - rest[i], v[i]
        bent += abs(x[i])
    if not (bent <= LITTLE and 4.0 * bent <= free):
        return -1.0
    for k in range(3):
        x[2 * n + k] = 0.0
        for i in range(3):
            x[2 * n + k] += root[1 + i, k] * shaken[i]
    # first only the new angles, without changing the state
    bent, gone = 0.0, 0.0
    for i in range(n):
        s = 0.0
        for j in range(2 * n + 3):
            s += answers[i, j] * x[j]
        bent += abs(s)
        gone += abs(s - x[i])
    if not (bent <= LITTLE and 4.0 * bent <= free):
        return -1.0
    for i in range(n):
        s, r = 0.0, 0.0
        for j in range(2 * n + 3):
            s += answers[i, j] * x[j]
            r += answers[n + i, j] * x[j]
        q[i], v[i] = rest[i] + s, r
    for i in range(6):
        load[i] -= state.weight[0, i]
    for m in range(2):
        for k in range(3):
            s = 0.0
            for j in range(2 * n + 3):
                s += answers[2 * n + 3 * m + k, j] * x[j]
            for i in range(3):
                load[3 * m + i] -= root[1 + i, k] * s
    for k in range(len(answers) - 2 * n - 6):
        s = 0.0
        for j in range(2 * n + 3):
            s += answers[2 * n + 6 + k, j] * x[j]
        contact[3 + k] += rest[k] + s
    return gone
