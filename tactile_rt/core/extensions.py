"""What other packages add: a name of theirs, where a name may be one of ours.

A package says in its pyproject.toml what it adds, by the entry points of a group:

    [project.entry-points."tactile_rt.sources"]
    weather = "tactile_weather:WeatherSource"

Once it is installed, ``weather:`` is a source everywhere. Ours are looked up first, so a package
adds names and replaces none; what it names is imported when it is asked for.
"""

from importlib import metadata
from typing import Any

from tactile_rt.core.errors import ConfigError

__all__ = [
    "ARRAYS",
    "CELLS",
    "CODECS",
    "OBJECTS",
    "PUBLISHERS",
    "SOURCES",
    "added",
    "added_names",
]

ARRAYS = "tactile_rt.arrays"  # paths of .csv or .toml files
CELLS = "tactile_rt.cells"  # classes, of `encoders.cells.Cell`
CODECS = "tactile_rt.codecs"  # classes, of `drivers.codec.Codec`, as serial.NAME or can.NAME
OBJECTS = "tactile_rt.objects"  # functions of a random generator, to convex pieces
PUBLISHERS = "tactile_rt.publishers"  # classes, of `daemon.consumer.Consumer`
# Classes of the target and their `Options`, or functions of the target and the options as written,
# which return the source.
SOURCES = "tactile_rt.sources"


def added_names(group: str) -> tuple[str, ...]:
    """The names that other packages add to a group, in alphabetical order; nothing is imported."""
    return tuple(sorted(metadata.entry_points(group=group).names))


def added(group: str, name: str) -> Any:
    """What another package adds by this name; None if none does.

    Raises:
        ConfigError: It cannot be imported; the message names the package.
    """
    for point in metadata.entry_points(group=group).select(name=name):
        try:
            return point.load()
        except Exception as error:  # another package's code
            package = f" of the package {point.dist.name}" if point.dist else ""
            kind = group.removeprefix("tactile_rt.").replace("_", " ").removesuffix("s")
            raise ConfigError(f"{kind} {name}{package} cannot be loaded: {error}") from None
    return None
