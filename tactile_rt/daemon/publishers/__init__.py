"""Publishers: consumers that send `messages` to others, each imported when it is asked for."""

from importlib import import_module
from typing import Any

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import lacking
from tactile_rt.core.settings import no_such

__all__ = ["PUBLISHERS", "load_class", "publisher_class"]

# kind: (where the class is, extra that it needs)
PUBLISHERS = {
    "jsonl": (f"{__name__}.jsonl:JsonlPublisher", ""),
    "zmq": (f"{__name__}.zmq:ZmqPublisher", "publish"),
    "zenoh": (f"{__name__}.zenoh:ZenohPublisher", "publish"),
    "foxglove": (f"{__name__}.foxglove:FoxglovePublisher", "publish"),
    "ros2": (f"{__name__}.ros2:Ros2Publisher", "ros2"),
}


def publisher_class(kind: str) -> Any:
    """The class of a kind of publisher.

    Raises:
        ConfigError: no such kind, it cannot be loaded, or an extra is not installed.
    """
    if kind in PUBLISHERS:
        where, extra = PUBLISHERS[kind]
        return load_class(where, f"publisher {kind}", extra)
    found = packages.added(packages.PUBLISHERS, kind)
    if found is not None:
        return found
    known = {*PUBLISHERS, *packages.added_names(packages.PUBLISHERS)}
    raise ConfigError(no_such("publisher", kind, sorted(known)))


def load_class(where: str, what: str, extra: str) -> Any:
    """Return the class at ``module:Class``, which needs an extra to be installed."""
    module, _, name = where.partition(":")
    try:
        return getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name == module:
            raise ConfigError(f"{what} is not in this release") from None
        raise lacking(f"{what} needs", extra, error) from None
