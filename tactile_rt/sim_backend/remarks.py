"""What a simulation cannot do as it was asked, in a line for the user."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.cells import link_nodes
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile, engine_of

__all__ = ["ringing", "strains"]

TOO_MUCH = 1.1  # a damping ratio so many times the wanted one is told
FINER = ("dataset", "accurate")


def ringing(animals: Sequence[WhiskerArray], profile: Profile) -> str:
    """Which whiskers ring shorter than they should at a profile; empty: none."""
    if engine_of(profile) != "rods":
        return ""
    whiskers = [w for animal in animals for w in animal.whiskers]
    off = _off(whiskers, profile)
    if not off:
        return ""
    wanted, had, worst = max(off, key=lambda one: one[1] / one[0])
    left = {key: len(_off(whiskers, PROFILES[key])) for key in FINER}
    best = min(left, key=lambda key: left[key])
    better = f"; at profile {best} {left[best] or 'none'}" if left[best] < len(off) else ""
    return (
        f"{len(off)} of {len(whiskers)} whiskers ring shorter than they should at steps of "
        f"{profile.timestep_ms:g} ms, {worst} with a damping ratio of {had:.2g} instead of "
        f"{wanted:.2g}{better}"
    )


def _off(whiskers: Sequence[Whisker], profile: Profile) -> list[tuple[float, float, str]]:
    """Of the whiskers whose ringing samples can hold and that ring too shortly: the damping ratio
    that is wanted, the one that is had, and the name."""
    from tactile_rt.sim_backend.rods.rod import HEARD_HZ, make_rod

    steps = round(SAMPLE_MS / profile.timestep_ms)
    rods = [make_rod(w, profile.links, steps) for w in whiskers]
    return [
        (rod.wanted_ratio, rod.damping_ratio, w.name)
        for rod, w in zip(rods, whiskers, strict=True)
        if rod.resonance_hz < HEARD_HZ and rod.damping_ratio > TOO_MUCH * rod.wanted_ratio
    ]


def strains(whiskers: Sequence[Whisker], links: int, angles: NDArray[np.float64]) -> list[float]:
    """The largest strain of each whisker at its surface: curvature times radius.

    Args:
        angles: (joint,) angles of all whiskers' hinges, one whisker after the other, rad.
    """
    found, first = [], 0
    for whisker in whiskers:
        first += 2 if whisker.mount_stiffness else 0  # the mount's own, which strain nothing
        bends = angles[first : first + 2 * links].reshape(-1, 2)
        first += 2 * links
        radii = whisker.radius(link_nodes(whisker, links)[1:-1])
        cell = whisker.length / links
        found.append(float((np.hypot(bends[:, 0], bends[:, 1]) / cell * radii).max()))
    return found
