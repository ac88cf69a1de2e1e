"""Checks of a configuration as a whole, beyond the types and ranges of single keys.

No device is opened or queried; named files must exist.
"""

import ipaddress
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tactile_rt.classifier.model_file import fit_source, read_model, shipped_model
from tactile_rt.classifier.runtime import onnxruntime_names
from tactile_rt.core.errors import SpecMismatch, TactileError
from tactile_rt.core.locks import device_keys
from tactile_rt.core.settings import no_such
from tactile_rt.core.stream import ArraySpec
from tactile_rt.daemon.config import Config, ModelConfig, SourceConfig, is_loopback
from tactile_rt.daemon.loading import Loaded
from tactile_rt.daemon.publishers import Wanted, wanted_consumers
from tactile_rt.daemon.service import MADE
from tactile_rt.sources.opening import check_source

SHORTEST_TOKEN = 16  # of a page that other computers can reach
HOST = re.compile(r"(?=.{1,253}\Z)([A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?\.?)+\Z")
ANY = ("", "*", "0.0.0.0", "::")

KeyPath = list[str | int]


def check_config(loaded: Loaded) -> None:
    """Raise `ConfigError` with file, line and key if the configuration cannot work."""
    config = loaded.config
    _check_names(loaded, config)
    arrays = {s.name: _check_source(loaded, i, s) for i, s in enumerate(config.source)}
    _check_devices(loaded, config)
    for i, model in enumerate(config.model):
        _check_model(loaded, ["model", i], model, arrays[model.source])
    _check_tables(loaded, config)
    found = wanted_consumers(loaded)
    _check_listeners(loaded, found)
    _check_domains(loaded, found)
    _check_outputs(loaded, found)
    for wanted in found:
        try:
            wanted.make()
        except TactileError as error:
            loaded.refuse(_find_path(loaded, wanted), str(error))


def _check_names(loaded: Loaded, config: Config) -> None:
    if not config.source:
        loaded.refuse(["source"], "there is no source: write [[source]] with a name and a url")
    names = [s.name for s in config.source]
    for i, name in enumerate(names):
        if name in names[:i]:
            loaded.refuse(["source", i, "name"], f"the name {name!r} is taken")
    for i, model in enumerate(config.model):
        if model.source not in names:
            loaded.refuse(["model", i, "source"], no_such("source", model.source, names))


def _check_source(loaded: Loaded, i: int, source: SourceConfig) -> ArraySpec | None:
    """Check a source's settings; return its array, or None if unknown before it is opened."""
    path: KeyPath = ["source", i]
    spec: ArraySpec | None = _try(loaded, [*path, "url"], check_source, source.url)
    given: dict[str, str] = {}
    for key in ("calibration", "array"):
        if value := getattr(source, key):
            given[key] = value
            spec = _try(loaded, [*path, key], lambda _: check_source(source.url, **given), value)
    return spec


def _check_model(
    loaded: Loaded, path: KeyPath, model: ModelConfig, array: ArraySpec | None
) -> None:
    if model.file and os.path.isdir(model.file):
        loaded.refuse([*path, "file"], f"{model.file} is a folder")
    file = Path(model.file) if model.file else shipped_model()
    if model.file:
        # How it behaves when it runs is tested by its trial, see `admission`.
        _try(loaded, [*path, "file"], lambda f: read_model(f, "step"), file)
    _try(loaded, [*path, "providers"], onnxruntime_names, model.providers)
    if model.every and model.mode != "sliding":
        loaded.refuse([*path, "every"], 'it is for mode = "sliding"')
    for key in ("every", "in_a_row"):
        if key not in loaded.nodes.at(path).value:
            continue
        value, steps = getattr(model, key), read_model(file)[0].steps
        if value > steps:
            allowed = f"a whole number <= {steps}, the steps that {file.name} has"
            loaded.refuse([*path, key], f"expected {allowed}, got {value}")
    if array is not None:
        try:
            fit_source(file, read_model(file)[0], array)
        except SpecMismatch as error:
            loaded.refuse([*path, "file"], f"source {model.source}: {error}")


def _check_devices(loaded: Loaded, config: Config) -> None:
    """Raise `ConfigError` if two sources share a device."""
    taken: dict[str, str] = {}
    for i, source in enumerate(config.source):
        for key in device_keys([source.url]):
            if key in taken:
                loaded.refuse(["source", i, "url"], f"source {taken[key]!r} has that {key}")
            taken[key] = source.name


def _check_tables(loaded: Loaded, config: Config) -> None:
    page, recorder, limits = config.page, config.recorder, config.limits
    if page is not None:
        _check_host(loaded, ["page", "host"], page.host)
    if page is not None and not is_loopback(page.host):
        if not page.token:
            loaded.refuse(
                ["page", "host"], f"{page.host} can be reached by others: page.token is needed"
            )
        if len(page.token) < SHORTEST_TOKEN:
            loaded.refuse(
                ["page", "token"],
                f"{len(page.token)} characters are too few beyond loopback: {SHORTEST_TOKEN} do",
            )
    if recorder is not None:
        _check_folder(loaded, recorder.folder)
        if 0 < recorder.rotate_mb < 1:
            loaded.refuse(["recorder", "rotate_mb"], "must be 0 (never) or at least 1")
        if 0 < recorder.rotate_s < 1:
            loaded.refuse(["recorder", "rotate_s"], "must be 0 (never) or at least 1")
        if recorder.mode == "trigger" and recorder.before_s + recorder.after_s == 0:
            loaded.refuse(
                ["recorder", "mode"], "a trigger with before_s = 0 and after_s = 0 keeps nothing"
            )
    if limits.retry_last_s < limits.retry_first_s:
        loaded.refuse(["limits", "retry_last_s"], "must not be below retry_first_s")


def _try(loaded: Loaded, path: KeyPath, check: Callable[[Any], Any], value: Any) -> Any:
    try:
        return check(value)
    except TactileError as error:
        loaded.refuse(path, str(error))
    except (OSError, ValueError) as error:  # a name that no file can have
        loaded.refuse(path, f"{value}: {error}")


# conflicts between tables, and values that no table can have


def _check_host(loaded: Loaded, path: KeyPath, host: str) -> None:
    """Raise `ConfigError` if a host is neither an IP address nor a valid host name."""
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        # Digits and dots alone are a malformed address, not a name.
        if not HOST.match(host) or re.fullmatch(r"[\d.]+", host):
            why = "no address: 127.0.0.1, ::1 or a host's name; a port has a key of its own"
            loaded.refuse(path, f"{host!r:.60} is {why}")


def _check_listeners(loaded: Loaded, wanted: Sequence[Wanted]) -> None:
    """Raise `ConfigError` if two consumers listen at one port."""
    taken: list[tuple[str, int, str]] = []
    for one in wanted:
        for key, host, port in _list_addresses(one):
            path = _find_path(loaded, one, key)
            if key == "port":
                _check_host(loaded, [*path[:-1], "host"], host)
            host = "127.0.0.1" if host == "localhost" else host.strip("[]")
            for other, number, name in taken:
                if port == number and (host == other or host in ANY or other in ANY):
                    loaded.refuse(path, f"{host}:{port} is where {name} listens")
            taken.append((host, port, one.name))


def _check_domains(loaded: Loaded, wanted: Sequence[Wanted]) -> None:
    """Raise `ConfigError` if two publishers share a DDS domain, which a process joins once."""
    taken: dict[int, str] = {}
    for one in wanted:
        if one.kind == "ros2":
            domain = one.options.domain
            if domain in taken:
                path = _find_path(loaded, one, "domain")
                loaded.refuse(path, f"DDS domain {domain} is where {taken[domain]} publishes")
            taken[domain] = one.name


def _check_outputs(loaded: Loaded, wanted: Sequence[Wanted]) -> None:
    """Raise `ConfigError` if an output file is invalid, an input, or written by two consumers."""
    config = loaded.config
    read = [str(loaded.path), *(m.file for m in config.model)]
    read += [file for s in config.source for file in (s.calibration, s.array)]
    inputs = {os.path.realpath(file) for file in read if file}
    taken: dict[str, str] = {}
    for one in wanted:
        if one.kind not in ("log", "jsonl"):
            continue
        path, file = _find_path(loaded, one, "file"), one.options.file
        if not file and one.kind == "log":
            continue
        if "\0" in file:
            loaded.refuse(path, "no file's name has a zero byte")
        made = Path(file).parent in MADE.values()
        if file and not made and not os.path.isdir(Path(file).parent):
            loaded.refuse(path, f"no folder {Path(file).parent}")
        if file and os.path.isdir(file):
            loaded.refuse(path, f"{file} is a folder")
        place = os.path.realpath(file) if file else "standard output"
        if place in inputs:
            loaded.refuse(path, f"{place} is read by this configuration: name another file")
        if place in taken:
            loaded.refuse(path, f"{place} is where {taken[place]} writes")
        taken[place] = one.name


def _check_folder(loaded: Loaded, folder: str) -> None:
    """Raise `ConfigError` if the recorder's folder cannot be created."""
    place = Path(folder)
    if "\0" in folder or (os.path.exists(folder) and not os.path.isdir(folder)):
        loaded.refuse(["recorder", "folder"], f"{folder!r} is not a folder")
    above = next((p for p in place.parents if os.path.lexists(p)), None)
    if above is not None and not os.path.isdir(above):
        loaded.refuse(["recorder", "folder"], f"{folder!r}: {above} is not a folder")
    elif above is not None and not shutil.disk_usage(above).total:  # such as /proc and /sys
        loaded.refuse(["recorder", "folder"], f"{folder!r}: {above} is on no disk")


def _list_addresses(wanted: Wanted) -> Iterator[tuple[str, str, int]]:
    """Yield (key, host, port) of each known address at which a consumer will listen.

    Ports chosen at startup and options of plugin consumers are unknown here, and left out.
    """
    options = wanted.options
    if wanted.kind in ("page", "metrics", "foxglove"):
        if options.port:
            yield "port", options.host, options.port
    elif wanted.kind == "zmq":
        if options.bind.startswith("tcp:") and not options.bind.endswith(":*"):
            yield "bind", *_split_address(options.bind.partition("://")[2])
    elif wanted.kind == "zenoh":
        for endpoint in options.listen:
            protocol, _, address = endpoint.partition("/")
            host, port = _split_address(re.split("[?#]", address)[0])
            if protocol in ("tcp", "tls", "ws") and port:
                yield "listen", host, port


def _split_address(address: str) -> tuple[str, int]:
    """Split ``HOST:PORT`` into its parts; the port is 0 if it is no number."""
    host, _, port = address.rpartition(":")
    return host, int(port) if port.isdecimal() else 0


def _find_path(loaded: Loaded, wanted: Wanted, key: str = "") -> KeyPath:
    """Return the key path of a consumer's table, or of `key` among its options."""
    table, _, name = wanted.name.partition(".")
    if table != "publisher":
        return [table, key] if key else [table]
    path: KeyPath = [table, [p.name for p in loaded.config.publisher].index(name)]
    return [*path, "options", key] if key else path
