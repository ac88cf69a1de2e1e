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
    found = {w.name: _ratios(w, profile) for w in whiskers}
    off = {name: ratios for name, ratios in found.items() if ratios[1] > TOO_MUCH * ratios[0]}
    if not off:
        return ""
    worst = max(off, key=lambda name: off[name][1] / off[name][0])
    wanted, had = off[worst]
    left = {}
    for key in FINER:
        ratios = [_ratios(w, PROFILES[key]) for w in whiskers]
        left[key] = sum(had > TOO_MUCH * wanted for wanted, had in ratios)
    best = min(left, key=lambda key: left[key])
    better = f"; at profile {best} {left[best] or 'none'}" if left[best] < len(off) else ""
    return (
        f"{len(off)} of {len(whiskers)} whiskers ring shorter than they should at steps of "
        f"{profile.timestep_ms:g} ms, {worst} with a damping ratio of {had:.2g} instead of "
        f"{wanted:.2g}{better}"
    )


def _ratios(whisker: Whisker, profile: Profile) -> tuple[float, float]:
    """The damping ratio that is wanted, and the one that is had, if samples can hold it at all."""
    from tactile_rt.sim_backend.rods.rod import HEARD_HZ, make_rod

    rod = make_rod(whisker, profile.links, round(SAMPLE_MS / profile.timestep_ms))
    if rod.resonance_hz >= HEARD_HZ:
        return 1.0, 1.0
    return rod.wanted_ratio, rod.damping_ratio


def strains(whiskers: Sequence[Whisker], links: int, angles: NDArray[np.float64]) -> list[float]:
    """The largest strain of each whisker at its surface: curvature times radius.

    Args:
        whiskers: whose joints they are.
        links: how many cells each is cut into.
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
