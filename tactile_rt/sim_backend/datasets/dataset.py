"""Making a sweep set: many objects, each swept past the array several times with drawn parameters.

Every sweep depends on its recipe, object and index alone, so a set does not depend on the machine,
the order or any interruptions. An object is one task, and becomes a file when all of its sweeps are
done.
"""

import hashlib
import os
from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError, SourceError, TactileError
from tactile_rt.core.packages import VERSION
from tactile_rt.core.settings import no_such
from tactile_rt.core.stream import Chunk
from tactile_rt.core.stream.sensor_spec import LOADS
from tactile_rt.sets.manifest import MANIFEST, SweepManifest, has_object
from tactile_rt.sets.objects import read_skipped, write_object, write_skipped
from tactile_rt.sets.splits import merge_categories
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.engines import ENGINES, run_processes, run_ray
from tactile_rt.sim_backend.datasets.inventory import remove_leftovers, write_sums, written_sum
from tactile_rt.sim_backend.datasets.recipe_objects import MeshObjects, ShapeObjects, choose_objects
from tactile_rt.sim_backend.datasets.recipes import ObjectChoice, SweepRecipe
from tactile_rt.sim_backend.mujoco_world import CONTACT_CHANNELS, contact_distances
from tactile_rt.sim_backend.objects.catalogue import TactileObject
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.transducer import FASTEST_HZ, Transducer, device_spec, sensor_of
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, engine_version, stamp_samples

# Types of a sweep's parameters; the others are floats.
KINDS: dict[str, type] = {"draw": np.int64, "touches": np.bool_, "unstable": np.bool_}
# streams of random numbers; that of the sweep's parameters is 0
RANDOMISATION, SENSOR, SHARED = 1, 2, 3
LOOKS = 3  # checks for contacts in each stored sample's period
SPARE = 2  # stored samples simulated beyond the last, which the resampler's kernel needs
DRAWS = 20  # tries to draw parameters with which an object meets the array at all

Floats = NDArray[np.float32]


def describe_set(recipe: SweepRecipe) -> SweepManifest:
    """Return the manifest of the set that a recipe makes.

    Raises:
        ConfigError: objects or array do not exist, or cannot be split as the recipe says.
    """
    objects, animals = choose_objects(recipe.objects), load_animals(recipe.array)
    heads = [(animal.whiskers, animal.mount) for animal in animals]
    morphology = repr(heads if len(heads) > 1 else heads[0])
    # Listed in full: a later release may know more categories.
    withheld, outliers = objects.withheld, recipe.objects.outliers
    chosen = msgspec.structs.replace(
        recipe.objects, categories=objects.categories, withheld=withheld
    )
    cutter = () if recipe.objects.generated else ("manifold3d",)
    packages = ("mujoco", "numpy", "scipy", "trimesh", *cutter)
    manifest = SweepManifest(
        spec=device_spec(animals),
        sensor=sensor_of(animals),
        period_ns=recipe.period_ns,
        lead=recipe.lead,
        categories=objects.categories,
        split=objects.split,
        recipe=replace(recipe, objects=chosen).to_dict(),
        withheld=(*withheld, *outliers),
        category_of=objects.category_of,
        kind_of=objects.kind_of,
        versions={
            "tactile_rt": VERSION,
            "engine": engine_version(PROFILES[recipe.profile]),
            **{p: version(p) for p in packages},
            "whiskers": hashlib.sha256(morphology.encode()).hexdigest()[:16],
        },
        settings=asdict(PROFILES[recipe.profile]),
    )
    return merge_categories(manifest, recipe.objects.classes)


def make_sweeps(
    recipe: SweepRecipe,
    folder: Path,
    processes: int | None = None,
    splits: Sequence[str] = (),
    engine: str = "processes",
    address: str | None = None,
) -> Generator[str, None, None]:
    """Simulate the missing sweeps of a set; yield each object's name once it is done.

    Args:
        folder: the set's folder; with "ray", on a file system that all machines share.
        processes: number of processes or tasks at a time; if None, one per core.
        engine: "processes" on this machine, or "ray" on a cluster.

    Raises:
        ConfigError: no such split or engine, or the folder holds another set, or sweeps without a
            manifest.
        TactileError: an object kills every process that tries to make it.
    """
    if engine not in ENGINES:
        raise ConfigError(no_such("engine", engine, ENGINES))
    manifest = describe_set(recipe)
    names = manifest.names(splits)  # refuses unknown splits before anything is written
    _refuse_strays(folder, manifest)
    manifest.write(folder)
    remove_leftovers(folder)
    skipped = read_skipped(folder)
    if broken := choose_objects(recipe.objects).skipped:
        skipped = broken | skipped
        write_skipped(folder, skipped)
    done = finished_objects(folder, names)
    yield from done
    todo = _interleave_splits(manifest, set(names) - set(done))
    work = _Work(recipe, folder.resolve())
    if engine == "ray":
        outcomes = run_ray(work, todo, processes, address)
    else:
        outcomes = run_processes(work, todo, processes or os.cpu_count() or 1)
    for name, failure in outcomes:
        if failure is not None:
            if recipe.objects.generated:  # no parametric object is broken
                raise TactileError(f"{name} cannot be made: {failure}")
            skipped[name] = failure
            write_skipped(folder, skipped)
        yield name
    write_sums(folder)


def _interleave_splits(manifest: SweepManifest, missing: set[str]) -> list[str]:
    """Sort missing objects so that all splits grow evenly, the test split twice as fast."""
    alike: dict[tuple[str, str], list[str]] = {}
    for side, names in manifest.split.items():
        for name in names:
            alike.setdefault((side, manifest.category(name)), []).append(name)
    place = {
        name: ((at + 1) / len(names) / (1 + (side == "test")), side)
        for (side, _), names in alike.items()
        for at, name in enumerate(names)
    }
    return sorted(missing, key=lambda name: (place[name], name))


def finished_objects(folder: Path, names: Sequence[str]) -> list[str]:
    """Return the named objects that are done: their file exists, or they are skipped."""
    skipped = read_skipped(folder) if folder.is_dir() else {}
    return [n for n in names if n in skipped or has_object(folder, n)]


def _refuse_strays(folder: Path, manifest: SweepManifest) -> None:
    """Raise a `ConfigError` for sweeps without a manifest, as they may be another set's."""
    if (folder / MANIFEST).exists() or not any(has_object(folder, n) for n in manifest.names()):
        return
    text = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
    if written_sum(folder, MANIFEST) != hashlib.sha256(text).hexdigest():
        raise ConfigError(
            f"{folder} holds sweeps but no {MANIFEST} that says what made them: choose another "
            "folder (a finished set goes on with the options that began it)"
        )


@dataclass(frozen=True)
class SweepRecord:
    """A simulated sweep: its sensor readings, its parameters, and its contacts if requested.

    Attributes:
        values: The (sample, element, channel) readings, SI; loads if the array has no sensor.
    """

    values: Floats
    parameters: dict[str, float]
    contacts: Floats | None = None


@dataclass(frozen=True)
class _Work:
    """A callable that stores all sweeps of an object, or returns why it cannot."""

    recipe: SweepRecipe
    folder: Path

    def __call__(self, name: str) -> str | None:
        if not self.folder.is_dir():
            raise ConfigError(
                f"{self.folder} is not on every machine: a cluster needs a shared file system"
            )
        if has_object(self.folder, name):  # another run may have made it meanwhile
            return None
        try:
            target = self._objects.load(name)
        except ConfigError as error:
            return str(error)
        records = [
            simulate_sweep(self.recipe, target, index) for index in range(len(self.recipe.sweeps))
        ]
        _write(self.folder, name, records, target)
        return None

    @property
    def _objects(self) -> ShapeObjects | MeshObjects:
        return _choose_objects_once(msgspec.json.encode(self.recipe.objects))


@lru_cache(maxsize=1)
def _choose_objects_once(choice: bytes) -> ShapeObjects | MeshObjects:
    """Return the chosen objects, cached per process, since Ray copies the work to each task."""
    return choose_objects(msgspec.json.decode(choice, type=ObjectChoice))


def _write(folder: Path, name: str, records: Sequence[SweepRecord], target: TactileObject) -> None:
    parameters: dict[str, NDArray[Any]] = {
        key: np.array([r.parameters[key] for r in records], dtype=KINDS.get(key, np.float64))
        for key in records[0].parameters
    }
    parameters["geometry"] = np.repeat(fingerprint(target), len(records))
    contacts = [r.contacts for r in records if r.contacts is not None]
    values, truth = np.stack([r.values for r in records]), np.stack(contacts) if contacts else None
    write_object(folder, name, values, parameters, truth)


def fingerprint(target: TactileObject) -> str:
    """Return a hash of the vertices and faces of an object's convex pieces."""
    digest = hashlib.sha256()
    for piece in target.pieces:
        digest.update(np.asarray(piece.vertices, dtype="<f8").tobytes())
        digest.update(np.asarray(piece.faces, dtype="<i8").tobytes())
    return digest.hexdigest()[:16]


def simulate_sweep(recipe: SweepRecipe, target: TactileObject, index: int) -> SweepRecord:
    """Simulate sweep `index` of an object, with the parameters that the recipe draws for it.

    If the sweep misses the array, too few whiskers reach the object or the simulation is unstable,
    it is drawn again, up to 20 draws in all; with listed values (`each`, `plus`) it is not.

    Returns:
        Values (sample, element, channel), SI, and the parameters of `sweep.Sweep` with `draw`, the
        sweep's number among those of its combination, `touches`, 0 if it misses the array,
        `unstable`, 1 if it could not be simulated at this profile (its values are 0 then),
        `saturated`, the share of the readings that the sensor clips, and `wedged`, the number of
        whiskers without room, see `SweepSimulation`. Contacts, if the recipe requests them, come
        from the simulation, without any sensor error.
    """
    rng, profile = recipe.rng(target.name, index), PROFILES[recipe.profile]
    ideal = load_animals(recipe.array)
    elements = sum(len(animal.whiskers) for animal in ideal)
    draws = recipe.rng(target.name, index, RANDOMISATION)
    animals = tuple(recipe.randomisation.draw(draws, animal) for animal in ideal)
    # A sweep that misses the array stays in a set that needs every combination.
    most = DRAWS if recipe.sweeps.combinations() == [{}] else 1
    for tries in range(most):
        shared = recipe.rng(target.name, recipe.sweeps.draw_index(index), SHARED)
        sweep = recipe.sweeps.draw(rng, index, shared)
        simulation = SweepSimulation(animals, target, sweep, profile)
        last = tries == most - 1
        if simulation.reached < recipe.sweeps.least_whiskers and not last:
            continue
        made = _simulate(recipe, simulation) if simulation.touches else None
        if made is not None:
            break
    loads, felt = made or (np.zeros((0, elements, len(LOADS))),) * 2
    values, saturated = _apply_sensor(recipe, target, index, loads)
    parameters = {
        **asdict(sweep),
        "draw": recipe.sweeps.draw_index(index),
        "touches": float(simulation.touches),
        "unstable": float(simulation.touches and made is None),
        "saturated": saturated,
        "wedged": float(len(simulation.wedged)),
    }
    # Through the same resampler as the loads, so that contacts and their loads are simultaneous.
    contacts = None
    if recipe.contacts:
        felt = felt[..., : len(CONTACT_CHANNELS)]
        contacts = contact_distances(_resample(recipe, _make_chunk(recipe, felt), FASTEST_HZ))
    return SweepRecord(values, parameters, contacts)


def _simulate(
    recipe: SweepRecipe, simulation: SweepSimulation
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Simulate a sweep at the simulator's own rate; return None if it is unstable.

    Returns:
        (sample, element, load) loads, in the order of `sensor_spec.LOADS`, and contacts, which are
        empty unless the recipe requests them.
    """
    lead, total = _count_samples(recipe)
    try:
        if recipe.contacts:
            every = max(1, int(recipe.period_ms / LOOKS / SAMPLE_MS))
            loads, contacts = simulation.advance_with_contacts(total - lead, every)
        else:
            loads = simulation.advance(total - lead)
            contacts = np.zeros((0, loads.shape[1], len(CONTACT_CHANNELS)))
    except SourceError:
        return None
    return np.concatenate([loads, simulation.turns()], axis=2), contacts


def _apply_sensor(
    recipe: SweepRecipe, target: TactileObject, index: int, loads: NDArray[np.float64]
) -> tuple[Floats, float]:
    """Convert loads to sensor readings (sample, element, channel); return the clipped share too.

    The described noise, offset and drift are not added here: training draws them anew each time
    that it uses a sweep.
    """
    # The description stays that of the ideal arrays: a robot does not know how its own differs.
    ideal = load_animals(recipe.array)
    spec, described = device_spec(ideal), sensor_of(ideal)
    if described is None:
        chunk: Chunk | None = _make_chunk(recipe, loads[..., : len(spec.channels)])
    else:
        chunk = Transducer(described, spec.elements).push(_make_chunk(recipe, loads))
    assert chunk is not None  # a lead and a sweep give at least one sample
    clipped = 0.0
    if described is not None or recipe.sensor != SensorModel():
        key = recipe.key(target.name, index, SENSOR)
        sensor = Sensor(recipe.sensor, spec, key, described, drawn=False)
        chunk = sensor.push(chunk) or chunk
        clipped = sensor.saturated / chunk.values.size
    return _resample(recipe, chunk, spec.rate_hz), clipped


def _count_samples(recipe: SweepRecipe) -> tuple[int, int]:
    """Return the number of simulator samples in the lead, and in lead and sweep together."""
    per_output = recipe.period_ms / SAMPLE_MS
    # One more, for the first output's kernel: it is centred one period after the first input.
    return round((recipe.lead + 1) * per_output), round((recipe.samples + SPARE) * per_output)


def _make_chunk(recipe: SweepRecipe, loads: NDArray[np.float64]) -> Chunk:
    """Make a chunk: zeros for the lead, loads (sample, element, channel), zeros to the end.

    At rest the whiskers carry no load, so the rest needs no simulation.
    """
    lead, total = _count_samples(recipe)
    values = np.zeros((total, *loads.shape[1:]), dtype=np.float32)
    values[lead : lead + len(loads)] = loads
    return stamp_samples(values)


def _resample(recipe: SweepRecipe, chunk: Chunk, rate_hz: float) -> Floats:
    """Resample a chunk like the live stream, to (sample, element, channel).

    With `every_nth` in the recipe, select the last sample up to each output's time instead.
    """
    if recipe.every_nth:
        due_ns = chunk.t_ns[0] + recipe.period_ns * np.arange(1, recipe.samples + 1)
        at = np.searchsorted(chunk.t_ns, due_ns, side="right") - 1
        taken: Floats = chunk.values[at]
        return taken
    outputs = Resampler(recipe.period_ns, rate_hz).push(chunk)
    values = np.zeros((recipe.samples, *chunk.values.shape[1:]), dtype=np.float32)
    if outputs is not None:  # fewer where the last samples were dropped
        n = min(len(outputs), recipe.samples)
        values[:n] = outputs.values[:n]
        values[n:] = outputs.values[n - 1]
    return values
