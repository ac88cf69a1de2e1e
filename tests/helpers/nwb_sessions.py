"""Sessions in the layout of the published NWB files, written with h5py in a moment.

Times are as the recordings' author shows them of one session (DANDI 000231, UsageNotes): trials
from 5.9 s of the session's clock on, first contact at 7.9 s, first spikes at 10.03 s, where the
recording begins. Spikes follow contact by a few ms, and the stimulus from contact to choice.
"""

import numpy as np

from tactile_rt.core.stream.stimuli import STIMULI

ORIGIN_S = 10.03
STRINGS = ("outcome", "stimulus", "servo_position")


def write_session(
    path, rng, tuned, animal="m", trials=72, task="discrimination", late=0.0, latency=0.006
):
    """A session of units with rates `tuned` (6, unit); spikes are `late` by so much."""
    import h5py

    units = tuned.shape[1]
    shown = rng.permutation(np.resize(np.arange(6), trials))
    begin = 5.91 + 6.5 * np.arange(trials)
    contact = begin + 2 + rng.uniform(0, 0.3, trials)
    contact[0] = 7.925
    choice = contact + rng.uniform(0.7, 1.2, trials)
    times, index = [], []
    for unit in range(units):
        rate, rest = tuned[shown, unit], tuned[:, unit].mean() / 3
        number = rng.poisson(rate * (choice - contact))
        drawn = np.repeat(contact + latency, number) + rng.random(number.sum()) * np.repeat(
            choice - contact, number
        )
        number = rng.poisson(0.1 * rate)  # a burst with contact
        burst = np.repeat(contact + latency, number) + 0.025 * rng.random(number.sum())
        idle = rng.uniform(begin[0], begin[-1] + 6, rng.poisson(rest * 6.5 * trials))
        of_unit = np.sort(np.concatenate([drawn, burst, idle]))
        times.append(of_unit[of_unit >= ORIGIN_S] + late)
        index.append(len(times[-1]))
    shapes, places = zip(*(STIMULI[s].split("-") for s in shown), strict=True)
    nothing = "nothing" if task == "detection" else "convex"
    columns = {
        "start_time": np.append(begin, begin[-1] + 6.5),
        "choice_time": np.append(choice, begin[-1] + 8),
        "outcome": [*["correct"] * trials, "error"],
        "stimulus": [*shapes, nothing],
        "servo_position": [*places, "close"],
        "ignore_trial": np.zeros(trials + 1, bool),
    }
    with h5py.File(path, "w") as file:
        file["general/subject/subject_id"] = animal
        file["general/experiment_description"] = f"whisker-based shape {task}."
        for name, values in columns.items():
            file[f"intervals/trials/{name}"] = values
        file["units/spike_times"] = np.concatenate(times)
        file["units/spike_times_index"] = np.cumsum(index)
        file["units/depth"] = np.linspace(100, 1000, units)
        file["units/inhibitory"] = np.arange(units) % 4 == 3
        series = file.create_group("acquisition/extracellular array recording")
        series["starting_time"] = ORIGIN_S
        series.attrs["neurodata_type"] = "ElectricalSeries"
        for w in range(2):
            file[f"processing/behavior/contacts_by_whisker_C{w}/start_time"] = np.sort(
                np.concatenate([contact[w::2], contact[w::2] + 0.15])
            )
            file[f"processing/behavior/processed_position_whisker_C{w}/angle/timestamps"] = (
                np.linspace(0, begin[-1] + 10, 50)
            )
    return path


def changed_copy(session, path, change):
    """Copy a session's file, change what h5py reads of it, and give its path."""
    import h5py

    path.write_bytes(session.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def write_animals(folder, seed=0, number=8, units=20, sessions=1, **kwargs):
    """Animals of one geometry, a folder of files `sub-NAME_ses-K_behavior+ecephys.nwb`."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=(6, 5))
    for i in range(number):
        for k in range(sessions):
            tuned = np.exp(shared @ rng.normal(size=(5, units)) / 3 + 2)
            name = f"sub-{i}_ses-{k}_behavior+ecephys.nwb"
            write_session(folder / name, rng, tuned, f"mouse-{i}", **kwargs)
    return folder
