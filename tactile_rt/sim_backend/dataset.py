"""Sweep sets: many objects, each swept past the array several times with drawn parameters.

Every object is an independent task with its own seed, so a set does not depend on the number of
processes, on their order, or on how often the run was interrupted.
"""

import multiprocessing
import os
import signal
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.recording import SweepManifest, has_object, split_by_object, write_object
from tactile_rt.sim_backend.array import PROFILES, SAMPLE_MS, array_spec
from tactile_rt.sim_backend.objects import CATEGORIES, make_object
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation, draw_simulation
from tactile_rt.sim_backend.whiskers import mouse_whiskers
from tactile_rt.stream import Chunk, ConfigError
from tactile_rt.timebase import Resampler

__all__ = ["PERIOD_NS", "SweepRecipe", "make_sweeps"]

PERIOD_NS = 9_000_000  # five sub-steps of 9 ms make one network step (Chung et al. 2025)
LEAD = 24  # stored samples at rest before the simulation starts: enough for a tare
SAMPLES = 164  # stored samples of one sweep, the lead included: 22 steps from onset and to spare


@dataclass(frozen=True)
class SweepRecipe:
    """How a sweep set is made.

    Attributes:
        categories: class names, each known to `make_object`.
        objects: instances of every category.
        validation, test: how many of them are held out, by object.
        sweeps: sweeps of every object.
        profile: simulation profile, see `array.PROFILES`.
        seed: of the drawn parameters.
    """

    categories: tuple[str, ...] = CATEGORIES
    objects: int = 60
    validation: int = 4
    test: int = 10
    sweeps: int = 8
    profile: str = "realtime"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.profile not in PROFILES:
            raise ConfigError(f"no profile {self.profile!r}: there are {', '.join(PROFILES)}")
        if min(self.objects - self.validation - self.test, self.validation, self.test) < 1:
            raise ConfigError(
                f"{self.objects} objects cannot be split with {self.validation} for validation "
                f"and {self.test} for test: each side needs at least one"
            )
        if self.sweeps < 1:
            raise ConfigError(f"sweeps must be at least 1, not {self.sweeps}")
        if self.seed < 0:
            raise ConfigError(f"seed must be 0 or more, not {self.seed}")

    def count(self, splits: tuple[str, ...]) -> int:
        """Objects of all categories in these splits.

        Raises:
            ConfigError: no such split.
        """
        split = self.manifest().split
        unknown = [s for s in splits if s not in split]
        if unknown:
            raise ConfigError(f"no split {unknown[0]!r}: there are {', '.join(split)}")
        return sum(len(split[s]) for s in splits)

    def manifest(self) -> SweepManifest:
        """The set that this recipe makes."""
        return SweepManifest(
            spec=array_spec(mouse_whiskers(), "mouse-right"),
            period_ns=PERIOD_NS,
            lead=LEAD,
            categories=self.categories,
            split=split_by_object(self.categories, self.objects, self.validation, self.test),
            recipe={k: v for k, v in asdict(self).items() if k != "categories"},
        )


def make_sweeps(
    recipe: SweepRecipe,
    folder: Path,
    processes: int | None = None,
    splits: tuple[str, ...] = ("train", "validation", "test"),
) -> Iterator[str]:
    """Make a sweep set, or what is missing of it; yields each object's name as it is finished.

    Raises:
        ConfigError: no such split, or the folder holds another set.
    """
    recipe.count(splits)  # which refuses unknown ones before anything is written
    manifest = recipe.manifest()
    manifest.write(folder)
    names = [n for s in splits for n in manifest.split[s]]
    done = [n for n in names if has_object(folder, n)]
    yield from done
    todo = [(recipe, folder, n) for n in names if n not in set(done)]
    if not todo:
        return
    # spawn: a forked copy of a process that runs threads (a progress bar) may hang.
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(processes or os.cpu_count() or 1, len(todo)), _quiet) as pool:
        yield from pool.imap_unordered(_make_object_sweeps, todo)


def _quiet() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


def _make_object_sweeps(task: tuple[SweepRecipe, Path, str]) -> str:
    recipe, folder, name = task
    category, _, index = name.rpartition("-")
    # Seeded by the object alone: the paired set of another profile draws the same sweeps.
    rng = np.random.default_rng([recipe.seed, zlib.crc32(category.encode()), int(index)])
    target = make_object(category, int(index))
    profile = PROFILES[recipe.profile]
    values, drawn = [], []
    for _ in range(recipe.sweeps):
        sweep, simulation = draw_simulation(rng, mouse_whiskers(), target, profile)
        values.append(_record(simulation))
        drawn.append(sweep)
    parameters = {
        f.name: np.array([getattr(s, f.name) for s in drawn], dtype=np.float64)
        for f in fields(Sweep)
    }
    write_object(folder, name, np.stack(values), parameters)
    return name


def _record(simulation: SweepSimulation) -> NDArray[np.float32]:
    """(SAMPLES, element, channel): a lead at rest, then the sweep, through the resampler.

    At rest the whiskers carry no load at all, so the lead needs no simulation.
    """
    per_output = PERIOD_NS / (SAMPLE_MS * 1e6)
    lead = round(LEAD * per_output)
    total = round((SAMPLES + 2) * per_output)
    loads = simulation.advance(total - lead)
    values = np.concatenate([np.zeros((lead, *loads.shape[1:])), loads]).astype(np.float32)
    seq = np.arange(total, dtype=np.int64)
    chunk = Chunk(
        seq, seq * round(SAMPLE_MS * 1e6), values, np.ones(values.shape[:2], dtype=np.bool_)
    )
    resampled = Resampler(PERIOD_NS, 1e3 / SAMPLE_MS).push(chunk)
    assert resampled is not None
    return resampled.values[:SAMPLES]
