"""Contacts with dry friction: the impulses that prevent overlap at the end of a step.

Along its normal a contact can only open; its friction opposes the slip with up to the coefficient
times the normal impulse. If the normal impulse is zero, the surfaces may part. Contacts are solved
one after another until none changes (Gauss-Seidel). In each, friction is a viscous drag whose
coefficient is iterated until the drag is Coulomb's, which leaves a linear problem with one unknown
per iteration. Unlike with the convex cones of many engines, a sliding contact does not open.
"""

import math
from typing import Any

from tactile_rt.sim_backend.rods.compiled import compile_cached

A = Any
CREEP = 2e-5  # mm/ms: below this slip, friction is less than Coulomb's
MOST_SWEEPS = 20
# Iterations of a contact's drag in the first sweep, and in later ones: in those the other contacts
# still change, which would undo more iterations.
MOST_ROUNDS, LATER_ROUNDS = 10, 2
TOLERANCE = 1e-4  # of the largest impulse


@compile_cached
def impulses(count: int, response: A, free: A, friction: float, drag: A, found: A) -> int:
    """Solve for the contact impulses that prevent overlap, with Coulomb friction.

    Args:
        count: number of contacts, each with a normal and two tangential directions.
        response: (3 contact, 3 contact) change of relative velocity per impulse.
        free: (3 contact,) relative velocity without any impulse, mm/ms; along the normal plus the
            gap over the step.
        drag: (contact,) initial friction impulses per slip; filled with the solution.
        found: (3 contact,) initial impulses; filled with the solution.

    Returns:
        The number of sweeps over the contacts.
    """
    for sweep in range(MOST_SWEEPS):
        largest, change = 0.0, 0.0
        for c in range(count):
            i = 3 * c
            w0, w1, w2 = free[i], free[i + 1], free[i + 2]
            for j in range(3 * count):
                if (j < i or j > i + 2) and found[j] != 0.0:
                    w0 += response[i, j] * found[j]
                    w1 += response[i + 1, j] * found[j]
                    w2 += response[i + 2, j] * found[j]
            n, t, s = 0.0, 0.0, 0.0
            r00, r01, r02 = response[i, i], response[i, i + 1], response[i, i + 2]
            if w0 < 0.0 and friction == 0.0:
                n = -w0 / r00
            elif w0 < 0.0:
                r11, r12, r22 = (
                    response[i + 1, i + 1],
                    response[i + 1, i + 2],
                    response[i + 2, i + 2],
                )
                d = drag[c]
                for _ in range(LATER_ROUNDS if sweep else MOST_ROUNDS):
                    # Slip under the drag: (1 + d R) slip = w + r n, r the slip per unit of n.
                    m11, m12, m22 = 1.0 + d * r11, d * r12, 1.0 + d * r22
                    det = m11 * m22 - m12 * m12
                    x1, x2 = (m22 * w1 - m12 * w2) / det, (m11 * w2 - m12 * w1) / det
                    y1, y2 = (m22 * r01 - m12 * r02) / det, (m11 * r02 - m12 * r01) / det
                    n = -(w0 - d * (r01 * x1 + r02 * x2)) / (r00 - d * (r01 * y1 + r02 * y2))
                    n = max(n, 0.0)
                    slip1, slip2 = x1 + y1 * n, x2 + y2 * n
                    t, s = -d * slip1, -d * slip2
                    square = slip1 * slip1 + slip2 * slip2
                    coulomb = friction * n / math.sqrt(square + CREEP * CREEP)
                    settled = abs(coulomb - d) * math.sqrt(square) <= 1e-5 * friction * n
                    d = coulomb
                    if settled:
                        break
                drag[c] = d
            change = max(change, abs(n - found[i]), abs(t - found[i + 1]), abs(s - found[i + 2]))
            largest = max(largest, n)
            found[i], found[i + 1], found[i + 2] = n, t, s
        if count == 1 or change <= TOLERANCE * largest:
            return sweep + 1
    return MOST_SWEEPS
