"""The consumers of a configuration; the module of a publisher is imported only if needed."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import lacking
from tactile_rt.core.settings import convert, make_node, no_such
from tactile_rt.daemon.config import Config, PublisherConfig
from tactile_rt.daemon.consumer import Consumer
from tactile_rt.daemon.loading import Loaded

__all__ = ["PUBLISHERS", "Wanted", "load_class", "publisher_class", "wanted_consumers"]

# kind: (where the class is, extra that it needs)
PUBLISHERS = {
    "jsonl": (f"{__name__}.jsonl:JsonlPublisher", ""),
    "zmq": (f"{__name__}.zmq:ZmqPublisher", "publish"),
    "zenoh": (f"{__name__}.zenoh:ZenohPublisher", "publish"),
    "foxglove": (f"{__name__}.foxglove:FoxglovePublisher", "publish"),
    "ros2": (f"{__name__}.ros2:Ros2Publisher", "ros2"),
}


def publisher_class(kind: str) -> Any:
    """Return the class of a kind of publisher, built in or from another package.

    Raises:
        ConfigError: The kind is unknown, cannot be loaded, or needs an extra to be installed.
    """
    if kind in PUBLISHERS:
        where, extra = PUBLISHERS[kind]
        return load_class(where, f"publisher {kind}", extra)
    found = packages.import_addition(packages.PUBLISHERS, kind)
    if found is not None:
        return found
    known = {*PUBLISHERS, *packages.added_names(packages.PUBLISHERS)}
    raise ConfigError(no_such("publisher", kind, sorted(known)))


def load_class(where: str, what: str, extra: str) -> Any:
    """Import and return the class at ``module:Class``; an error names the missing extra."""
    module, _, name = where.partition(":")
    try:
        return getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name == module:
            raise ConfigError(f"{what} is not in this release") from None
        raise lacking(f"{what} needs", extra, error) from None


_HERE = "tactile_rt.daemon"

TABLES = ("log", "recorder", "page", "metrics")  # each a class of its own module


@dataclass(frozen=True)
class Wanted:
    """A consumer that a configuration requires, not yet created.

    Attributes:
        name: The name of the part that runs the consumer, e.g. ``publisher.zmq``.
        key: Equal for consumers with the same configuration, so that a running one goes on.
        make: Creates the consumer; may raise `ConfigError`.
        options: The table of the configuration; for a publisher, that of its ``options``.
    """

    name: str
    kind: str
    key: Any
    make: Callable[[], Consumer]
    options: Any = None


def wanted_consumers(loaded: Loaded) -> list[Wanted]:
    """List the consumers of a configuration, without creating them.

    Raises:
        ConfigError: A kind of publisher is unknown, or an option is wrong.
    """
    config, limits = loaded.config, loaded.config.limits
    wanted = [_resolve(loaded, i, publisher) for i, publisher in enumerate(config.publisher)]
    for table in TABLES:
        if (options := getattr(config, table)) is not None:
            cls = load_class(f"{_HERE}.{table}:{table.title()}", table, "")
            make = partial(cls, table, options)
            wanted.append(Wanted(table, table, (options, limits), make, options))
    wanted.sort(key=lambda one: one.kind != "log")  # the log first, for the events of all others
    if os.environ.get("NOTIFY_SOCKET"):
        cls = load_class(f"{_HERE}.systemd:Systemd", "systemd", "")
        wanted.append(Wanted("systemd", "systemd", limits, partial(cls, "systemd", None)))
    return wanted


def _resolve(loaded: Loaded, i: int, config: PublisherConfig) -> Wanted:
    try:
        cls = publisher_class(config.kind)
    except ConfigError as error:
        loaded.refuse(["publisher", i, "kind"], str(error))
    path: list[str | int] = ["publisher", i, "options"]
    options: Any = None
    kind = getattr(cls, "Options", None)
    if kind is None and config.options:
        loaded.refuse(path, f"publisher {config.kind} takes no options")
    if kind is not None and config.options:
        options = convert(loaded.nodes, kind, path, top=Config)
    elif kind is not None:
        try:
            options = convert(make_node({}, "options", 0, Path()), kind)
        except ConfigError as error:  # some are required
            loaded.refuse(["publisher", i], str(error))
    key = (config.kind, config.name, options, loaded.config.limits)
    name = f"publisher.{config.name}"
    return Wanted(name, config.kind, key, partial(cls, name, options), options)
