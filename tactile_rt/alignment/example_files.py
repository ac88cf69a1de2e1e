"""Files of the synthetic brain: NWB sessions like the real recordings, and models to score.

A trial lasts four seconds. Whiskers touch a few times between first contact and choice.
From `LATENCY_S` after first contact to the choice a unit fires at its rate for the stimulus, mostly
just after each contact; at other times, at a third of its mean rate. Spikes are on the session's
clock, as NWB defines; the electrical recording begins at `BEGIN_S`, without spikes before.
"""

import json
import uuid
from collections.abc import Callable, Mapping
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.example import MODELS, Brain, example_models, gains
from tactile_rt.alignment.rdm import Floats
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import replace_folder
from tactile_rt.core.stream.stimuli import STIMULI

if TYPE_CHECKING:
    import h5py

TRIAL_S = 4.0
FIRST_S, BEGIN_S = 5.9, 10.03  # start of the first trial and of the electrical recording
CONTACT_S, CHOICE_S = (0.8, 1.2), (0.8, 1.2)  # from start to first contact; from it to choice
CONTACTS = 3  # mean number of contacts in a trial, after the first
LATENCY_S, BURST_S = 0.005, 0.035  # from a contact to its burst, and the length of the burst
BURST = 3.0  # rate in a burst, as a multiple of the rate between bursts
REST = 1 / 3  # rate without contact, as a share of a unit's mean rate
WRONG = 12  # additional trials of every session that end in error, and so do not count
SAMPLING_HZ, WHISKER_HZ = 30_000.0, 200.0
WHISKERS = ("C0", "C1", "C2", "C3")
DATE = "2020-01-01T00:00:00+00:00"
DEPTHS_UM = (100.0, 1100.0)
INHIBITORY = 0.2  # probability that a unit is inhibitory


def write_example(
    folder: Path,
    brain: Brain,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Path, Path]:
    """Write recordings of a synthetic brain, and models whose true scores are known.

    Args:
        folder: the folder to make; it must not exist.
        seed: seed of all random numbers, 0 or more.

    Returns:
        The folder of NWB files, one per session, and the folder of models, ``.npz`` of responses
        (6, unit) by layer. ``truth.json`` in `folder` holds the parameters and the true geometry.

    Raises:
        ConfigError: the folder exists, or the seed is below 0.
        OSError: the disk is full; the error names `folder`.
    """
    import h5py

    if seed < 0:
        raise ConfigError(f"seed must be 0 or more, not {seed}")
    if folder.exists():
        raise ConfigError(f"{folder} already exists: name a new folder")
    truth, models, mice = (np.random.default_rng([seed, part]) for part in range(3))
    shared = brain.geometry(truth)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with replace_folder(folder) as made:
        for part in ("recordings", "models"):
            (made / part).mkdir()
        for name, layers in example_models(brain, models, shared).items():
            np.savez(made / "models" / f"{name}.npz", **layers)  # type: ignore[arg-type]
        for k in range(brain.mice):
            name = f"mouse-{k + 1:02d}"
            features = brain.features(mice, shared)
            home = made / "recordings" / f"sub-{name}"
            home.mkdir()
            for j in range(brain.sessions):
                path = home / f"sub-{name}_ses-{j + 1}_behavior+ecephys.nwb"
                rates = brain.rates(mice, features, brain.units)
                whole = BytesIO()  # on a full disk, HDF5 raises no OSError and prints many lines
                with h5py.File(whole, "w") as file:
                    _write_session(file, mice, name, rates, brain.trials)
                path.write_bytes(whole.getbuffer())
                progress((k * brain.sessions + j + 1) / (brain.mice * brain.sessions))
        facts = {"brain": asdict(brain), "seed": seed, "lost": MODELS, "shared": shared.tolist()}
        (made / "truth.json").write_text(json.dumps(facts, indent=1) + "\n")
    return folder / "recordings", folder / "models"


def _write_session(
    file: "h5py.File", rng: np.random.Generator, animal: str, rates: Floats, trials: int
) -> None:
    """Write a session to an NWB file, for units with mean rates (6, unit), spikes/s."""
    n = len(STIMULI) * trials + WRONG
    stimulus = rng.permutation(np.resize(np.arange(len(STIMULI)), n))
    correct = np.zeros(n, dtype=np.bool_)
    for k in range(len(STIMULI)):  # `trials` correct trials of each stimulus
        correct[rng.permutation(np.flatnonzero(stimulus == k))[:trials]] = True
    start = FIRST_S + TRIAL_S * np.arange(n)
    first = start + rng.uniform(*CONTACT_S, size=n)
    choice = first + rng.uniform(*CHOICE_S, size=n)
    later = [
        np.sort(rng.uniform(a + 0.1, b - 0.05, rng.poisson(CONTACTS)))
        for a, b in zip(first, choice, strict=True)
    ]
    contacts = [np.concatenate([[a], more]) for a, more in zip(first, later, strict=True)]
    end = float(start[-1] + TRIAL_S)
    shapes, places = zip(*(STIMULI[s].split("-") for s in stimulus), strict=True)

    _write_head(file, animal)
    columns: dict[str, ArrayLike] = {
        "start_time": start,
        "stop_time": start + TRIAL_S,
        "choice_time": choice,
        "outcome": np.where(correct, "correct", "error"),
        "stimulus": shapes,
        "servo_position": places,
        "ignore_trial": np.zeros(n, dtype=np.bool_),
    }
    _write_table(file, "intervals/trials", columns, "TimeIntervals", "trials")
    whiskers = rng.integers(len(WHISKERS), size=n)
    _write_whiskers(file, contacts, whiskers, end)
    gain = gains(rng, n)
    spikes = [
        _draw_unit(rng, rates[stimulus, unit] * gain, rates[:, unit].mean(), contacts, choice, end)
        for unit in range(rates.shape[1])
    ]
    _write_units(file, rng, spikes)


def _draw_unit(
    rng: np.random.Generator,
    rate: Floats,
    mean: float,
    contacts: list[Floats],
    choice: Floats,
    end: float,
) -> Floats:
    """Draw a unit's spike times, s, at `rate` (trial,) in trials, else at rest."""
    begin = np.array([times[0] for times in contacts]) + LATENCY_S
    bursts = np.array([len(times) for times in contacts]) * BURST_S
    # Between bursts the rate is lower, so that a trial keeps its mean rate.
    calm = rate / (1 + (BURST - 1) * bursts / (choice - begin))
    parts = [
        _draw_spikes(rng, begin, choice - begin, calm),
        _draw_spikes(
            rng,
            np.concatenate(contacts) + LATENCY_S,
            np.full(sum(map(len, contacts)), BURST_S),
            np.repeat((BURST - 1) * calm, [len(times) for times in contacts]),
        ),
        _draw_spikes(
            rng,
            np.concatenate([[0], choice]),
            np.diff(np.stack([np.concatenate([[0], choice]), np.append(begin, end)]), axis=0)[0],
            np.full(len(choice) + 1, REST * mean),
        ),
    ]
    times: Floats = np.sort(np.round(np.concatenate(parts) * SAMPLING_HZ) / SAMPLING_HZ)
    return times[times >= BEGIN_S]


def _draw_spikes(rng: np.random.Generator, begin: Floats, length: Floats, rate: Floats) -> Floats:
    """Draw Poisson spike times in windows of given begin, length and rate (window,)."""
    number = rng.poisson(rate * length)
    return np.asarray(
        np.repeat(begin, number) + rng.random(number.sum()) * np.repeat(length, number)
    )


# The subset of NWB 2 that its readers need.


def _set_type(item: Any, kind: str, namespace: str = "core", **attributes: Any) -> Any:
    item.attrs["neurodata_type"] = kind
    item.attrs["namespace"] = namespace
    place = f"{Path(item.file.filename).name}{item.name}"
    item.attrs["object_id"] = str(uuid.uuid5(uuid.NAMESPACE_URL, place))
    for name, value in attributes.items():
        item.attrs[name] = value
    return item


def _make_group(file: "h5py.File", name: str, kind: str, **attributes: Any) -> Any:
    return _set_type(file.require_group(name), kind, **attributes)


def _make_text(values: ArrayLike) -> Any:
    return np.array(values, dtype=np.object_)


def _write_head(file: "h5py.File", animal: str) -> None:
    import h5py

    _set_type(file, "NWBFile", nwb_version="2.7.0")
    file["identifier"] = Path(file.filename).name
    file["session_description"] = "made up: a synthetic session of known truth"
    file["session_start_time"] = file["timestamps_reference_time"] = DATE
    file["file_create_date"] = _make_text([DATE])
    stimulus = "stimulus/presentation", "stimulus/templates"
    for name in ("acquisition", "analysis", "general", "intervals", "processing", *stimulus):
        file.create_group(name)
    subject = _make_group(file, "general/subject", "Subject")
    subject["subject_id"], subject["species"] = animal, "none: synthetic"
    _make_group(file, "general/devices/probe", "Device", description="none: synthetic")
    shank = _make_group(file, "general/extracellular_ephys/shank", "ElectrodeGroup",
                        description="none: synthetic", location="barrel cortex")  # fmt: skip
    shank["device"] = h5py.SoftLink("/general/devices/probe")
    electrodes = _write_table(
        file,
        "general/extracellular_ephys/electrodes",
        {"location": ["barrel cortex"], "group_name": ["shank"]},
        "DynamicTable",
        "the one electrode",
        more=("group",),
    )
    references = np.array([shank.ref], dtype=h5py.ref_dtype)
    _set_type(electrodes.create_dataset("group", data=references, dtype=h5py.ref_dtype),
              "VectorData", "hdmf-common", description="group")  # fmt: skip
    series = _make_group(file, "acquisition/extracellular array recording", "ElectricalSeries",
                         description="not kept", comments="no comments")  # fmt: skip
    data = series.create_dataset("data", data=np.zeros((1, 1)))
    data.attrs.update(unit="volts", conversion=1.0, offset=0.0, resolution=-1.0)
    start = series.create_dataset("starting_time", data=BEGIN_S)
    start.attrs.update(rate=SAMPLING_HZ, unit="seconds")
    region = series.create_dataset("electrodes", data=np.zeros(1, dtype=np.int64))
    _set_type(region, "DynamicTableRegion", "hdmf-common", description="all", table=electrodes.ref)


def _write_table(
    file: "h5py.File",
    name: str,
    columns: Mapping[str, ArrayLike],
    kind: str,
    description: str,
    more: tuple[str, ...] = (),
) -> Any:
    """Write a table of columns by name; the caller adds the columns named in `more`."""
    namespace = "hdmf-common" if kind == "DynamicTable" else "core"
    table = _set_type(file.require_group(name), kind, namespace, description=description,
                      colnames=_make_text([*columns, *more]))  # fmt: skip
    rows = 0
    for column, values in columns.items():
        array = np.asarray(values)
        rows = len(array)
        stored = _make_text(array) if array.dtype.kind == "U" else array
        data = table.create_dataset(column, data=stored)
        _set_type(data, "VectorData", "hdmf-common", description=column)
    identity = table.create_dataset("id", data=np.arange(rows))
    _set_type(identity, "ElementIdentifiers", "hdmf-common")
    return table


def _write_whiskers(
    file: "h5py.File", contacts: list[Floats], whisker: NDArray[np.int64], end: float
) -> None:
    _make_group(file, "processing/behavior", "ProcessingModule", description="whiskers")
    for k, name in enumerate(WHISKERS):
        own = [times for times, w in zip(contacts, whisker, strict=True) if w == k]
        times = np.concatenate([np.empty(0), *own])
        columns = {"start_time": times, "stop_time": times + 0.02}
        where = f"processing/behavior/contacts_by_whisker_{name}"
        _write_table(file, where, columns, "TimeIntervals", "contacts")
        where = f"processing/behavior/processed_position_whisker_{name}"
        _make_group(file, where, "CompassDirection")
        angle = _make_group(file, f"{where}/angle", "SpatialSeries",
                            description="not kept", comments="no comments")  # fmt: skip
        # Two samples give the length of the video.
        data = angle.create_dataset("data", data=np.zeros(2))
        data.attrs.update(unit="degrees", conversion=1.0, offset=0.0, resolution=-1.0)
        clock = angle.create_dataset("timestamps", data=[0.0, end + 1 / WHISKER_HZ])
        clock.attrs.update(interval=1, unit="seconds")
        angle["reference_frame"] = "face"


def _write_units(file: "h5py.File", rng: np.random.Generator, spikes: list[Floats]) -> None:
    number = len(spikes)
    columns = {
        "depth": rng.uniform(*DEPTHS_UM, size=number),
        "inhibitory": rng.random(number) < INHIBITORY,
    }
    table = _write_table(file, "units", columns, "Units", "made-up units", more=("spike_times",))
    times = table.create_dataset(
        "spike_times", data=np.concatenate(spikes), compression="gzip", shuffle=True
    )
    _set_type(times, "VectorData", "hdmf-common", description="spike times, s")
    ends = table.create_dataset("spike_times_index", data=np.cumsum([len(s) for s in spikes]))
    _set_type(ends, "VectorIndex", "hdmf-common", description="ends", target=times.ref)
