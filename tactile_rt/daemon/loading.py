"""Loading of a configuration from one file and from settings of the command line.

Every error is one line that names file and line (or the ``--set``), the key, and the nearest valid
name.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import open_regular
from tactile_rt.core.settings import SettingNode, convert, read_toml, refusal, set_key
from tactile_rt.daemon.config import CONFIG_VERSION, Config

LARGEST = 1 << 20  # bytes of a configuration
FILES_IN = ("replay", "combined")  # schemes of URLs whose target is a file


@dataclass(frozen=True)
class Loaded:
    """A configuration, with the file and line of each of its values.

    Attributes:
        config: The configuration, with all names filled in and all paths absolute.
        nodes: The tree of settings that the configuration was made from, with their lines.
    """

    config: Config
    nodes: SettingNode
    path: Path

    def refuse(self, path: list[str | int], why: str) -> NoReturn:
        """Raise a `ConfigError` about the value at a key path."""
        raise refusal(self.nodes, path, why)


def load_config(path: Path, sets: Sequence[str] = ()) -> Loaded:
    """Read a configuration from a file, with settings that override it.

    Args:
        sets: ``a.b=value``; ``source.NAME.url=...`` selects an item of a list by its name.

    Raises:
        ConfigError: The configuration is invalid; the message names file, line and key.
    """
    try:
        with suppress(FileNotFoundError, ValueError):  # `read_toml` reports these
            open_regular(path).close()  # reading a pipe could block for ever
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    nodes = read_toml(path, LARGEST)
    for text in sets:
        nodes = set_key(nodes, text, Config)
    _check_version(nodes)
    _resolve_paths(nodes)
    config = convert(nodes, Config)
    loaded = Loaded(config, nodes, path)
    return Loaded(_fill_names(loaded), nodes, path)


def _resolve_paths(nodes: SettingNode) -> None:
    """Make relative paths absolute in place, from the folder of the file that states them."""
    for path, node in nodes.walk():
        if not isinstance(node.value, str) or not node.value or "\0" in node.value:
            continue
        last = path[-1] if path else ""
        top = (path[0], last) if path else ()
        files = (("source", "array"), ("model", "file"), ("recorder", "folder"), ("log", "file"))
        if top in files or (
            path[0] == "publisher"
            and "options" in path
            and (last in ("file", "folder") or str(last).endswith("_file"))
        ):
            node.value = str(_resolve_path(node, node.value))
        elif top == ("source", "calibration") and _is_file(_resolve_path(node, node.value)):
            node.value = str(_resolve_path(node, node.value))
        elif top == ("source", "url"):
            scheme, colon, rest = node.value.partition(":")
            target, question, options = rest.partition("?")
            shipped = (scheme, target) == ("replay", "demo")
            if colon and scheme in FILES_IN and target and not shipped:
                node.value = f"{scheme}:{_resolve_path(node, target)}{question}{options}"


def _resolve_path(node: SettingNode, value: str) -> Path:
    path = Path(value)
    if value.startswith("~"):
        try:
            path = path.expanduser()
        except RuntimeError:  # no such user
            raise ConfigError(f"{node.where}: {value} names no user of this computer") from None
    return path if path.is_absolute() else node.folder / path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # too long a name
        return False


def _fill_names(loaded: Loaded) -> Config:
    """Return the configuration with omitted names of models and publishers filled in."""
    config = loaded.config
    sources = [s.name for s in config.source]
    models, publishers = [], []
    taken: set[str] = set()
    for i, model in enumerate(config.model):
        source = model.source
        if not source:
            if len(sources) != 1:
                loaded.refuse(
                    ["model", i], f"which source? source = one of {', '.join(sources) or 'none'}"
                )
            (source,) = sources
        name = _assign_name(model.name or source, taken, bool(model.name), loaded, ["model", i])
        models.append(msgspec.structs.replace(model, source=source, name=name))
    taken = {"recorder", "page", "metrics", "systemd", "log"}
    for i, publisher in enumerate(config.publisher):
        base = publisher.name or re.sub(r"[^A-Za-z0-9_-]", "-", publisher.kind)
        name = _assign_name(base, taken, bool(publisher.name), loaded, ["publisher", i])
        publishers.append(msgspec.structs.replace(publisher, name=name))
    return msgspec.structs.replace(config, model=tuple(models), publisher=tuple(publishers))


def _assign_name(
    name: str, taken: set[str], given: bool, loaded: Loaded, path: list[str | int]
) -> str:
    made, n = name, 1
    while made in taken:
        if given:
            loaded.refuse([*path, "name"], f"the name {name!r} is taken")
        n += 1
        made = f"{name}-{n}"
    taken.add(made)
    return made


def _check_version(nodes: SettingNode) -> None:
    version = nodes.value.get("version")
    if version is None:
        raise ConfigError(
            f"{nodes.file}:1: no version: begin the file with version = {CONFIG_VERSION}"
        )
    if version.value != CONFIG_VERSION or isinstance(version.value, bool | float):
        raise ConfigError(
            f"{version.where}: version {version.value!r}; this release reads {CONFIG_VERSION}"
        )
