"""From recordings to a frozen benchmark."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from tactile_rt.models.alignment.benchmark import PROTOCOLS, Benchmark
from tactile_rt.models.alignment.neural import by_animal, published_layout
from tactile_rt.models.alignment.nwb import find_nwb, read_nwb
from tactile_rt.models.alignment.paper_code import freeze_paper_code
from tactile_rt.models.alignment.published import read_published
from tactile_rt.models.alignment.reliability import BOOTSTRAPS, SEED
from tactile_rt.models.alignment.strict import freeze_strict
from tactile_rt.stream import ConfigError

__all__ = ["build"]

# Of the time that a build takes; the rest is bootstraps.
READING = 0.8


def build(
    inputs: Sequence[Path],
    protocol: str = "strict",
    bootstraps: int = BOOTSTRAPS,
    seed: int = SEED,
    progress: Callable[[float], None] = lambda share: None,
) -> Benchmark:
    """Freeze a benchmark from NWB files or from rates in the published layout.

    Args:
        inputs: NWB files and folders of them; or, for paper-code, one published ``.npz``.
        protocol: ``strict`` or ``paper-code``.
        bootstraps, seed: of the splits.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: recordings that cannot be used, and why.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}")
    if not inputs:
        raise ConfigError("name NWB files or a folder of them to build from")
    if bootstraps < 1:
        raise ConfigError(f"{bootstraps} bootstraps: at least one")
    archives = [path for path in inputs if path.suffix == ".npz"]
    if archives and len(inputs) > 1:
        raise ConfigError(f"{archives[0]}: an .npz holds all animals: name nothing beside it")
    if archives and protocol == "strict":
        raise ConfigError(
            f"{archives[0]}: its stimuli have no names, and trials that did not show a stimulus "
            "count as zero: build with protocol paper-code, or strict from the NWB files"
        )

    def reading(share: float) -> None:
        progress(READING * share)

    def splitting(share: float) -> None:
        progress(READING + (1 - READING) * share)

    if archives:
        rates = read_published(archives[0])
        made = freeze_paper_code(rates, bootstraps, seed, splitting)
        return replace(made, sources=(archives[0].name,))
    files = find_nwb(inputs)
    window = "contact" if protocol == "strict" else "start"
    sessions, notes = read_nwb(files, window, reading)
    animals = by_animal(sessions)
    if protocol == "strict":
        made = freeze_strict(animals, bootstraps, seed, splitting)
    else:
        layouts = {animal.name: published_layout(animal) for animal in animals}
        made = freeze_paper_code(layouts, bootstraps, seed, splitting)
    return replace(made, sources=tuple(sorted(f.name for f in files)), notes=(*notes, *made.notes))
