"""A whisker cut into equal cells: the links of a chain, hinged in the middle of every cell.

Lengths in mm, masses in mg, forces in mN.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.whiskers import Whisker

__all__ = ["joint_stiffness", "link_inertia", "link_nodes"]

GAUSS = np.polynomial.legendre.leggauss(5)  # nodes, weights: exact to degree 9


def link_nodes(whisker: Whisker, links: int) -> NDArray[np.float64]:
    """(links + 2,) arc lengths (mm) of the links' ends: base, joints in mid-cell, tip."""
    joints = (np.arange(links) + 0.5) * (whisker.length / links)
    return np.concatenate([[0.0], joints, [whisker.length]])


def joint_stiffness(whisker: Whisker, start: float, stop: float) -> float:
    """Stiffness (uN m / rad) of the joint in the middle of a cell.

    The cell adds to the bend of a tip under a force what the beam's own piece adds, the integral of
    (L - s)^2 / E I: towards a thin tip that is more than its middle's E I would give.
    """
    s, weights = start + (GAUSS[0] + 1) * (stop - start) / 2, GAUSS[1] * (stop - start) / 2
    lever = whisker.length - s
    bend = float(weights @ (lever**2 / whisker.bending_stiffness(s)))  # 1/N
    return (whisker.length - (start + stop) / 2) ** 2 / bend * 1e3


def link_inertia(whisker: Whisker, start: float, stop: float) -> tuple[float, float, float, float]:
    """Mass (mg), centroid (mm from start), axial and transverse inertia (mg mm^2) of a link.

    Of the tapered piece itself: a uniform link would have its mass too far out, and the whole
    whisker a first resonance up to 3 % too low.
    """
    x, weights = (GAUSS[0] + 1) * (stop - start) / 2, GAUSS[1] * (stop - start) / 2
    radius = whisker.radius(start + x)
    mass = weights * whisker.density(start + x) * 1e-3 * np.pi * radius**2
    total = float(mass.sum())
    centre = float(mass @ x / total)
    axial = float(mass @ radius**2 / 2)
    return total, centre, axial, float(mass @ (radius**2 / 4 + (x - centre) ** 2))
