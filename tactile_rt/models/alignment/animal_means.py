"""Mean responses of animals, (6, unit): what is decoded of them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.building import checked_sessions
from tactile_rt.models.alignment.neural import by_animal
from tactile_rt.models.alignment.nwb import find_nwb
from tactile_rt.models.alignment.published import read_published
from tactile_rt.models.alignment.rdm import STIMULI
from tactile_rt.models.alignment.reliability import trial_mean

__all__ = ["animal_means"]


def animal_means(path: Path) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """By animal, the mean over trials of every unit, and notes on what was left out.

    Args:
        path: rates in the published layout, ``.npz``, as their authors publish them, mistakes
            included (`neural.published_layout`); or an NWB file, or a folder of them.

    Raises:
        ConfigError: recordings that cannot be used, and why.
    """
    if path.suffix == ".npz":
        return {name: trial_mean(rates) for name, rates in read_published(path).items()}, []
    sessions, notes = checked_sessions(find_nwb([path]))
    means = {}
    for animal in by_animal(sessions):
        whole = [s for s in animal.sessions if s.trials.min() > 0]
        if not whole:
            notes.append(f"animal {animal.name} left out: no session has every stimulus")
            continue
        means[animal.name] = np.concatenate(
            [
                np.stack([s.rates[s.stimulus == k].mean(axis=0) for k in range(len(STIMULI))])
                for s in whole
            ],
            axis=1,
        )
    return means, notes
