"""What one key alone does not tell: whether a configuration as a whole can work.

Nothing is opened, and no device is asked; files that are named must be there.
"""

import dataclasses
import math
import os
import re
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from tactile_rt.calibration import load_calibration
from tactile_rt.classifier.model_file import load_model
from tactile_rt.classifier.runtime import onnxruntime_names
from tactile_rt.daemon.config import Config
from tactile_rt.daemon.config_file import Loaded
from tactile_rt.daemon.config_shared import (
    check_folder,
    check_host,
    check_listeners,
    check_outputs,
    is_loopback,
)
from tactile_rt.daemon.config_tables import WORDS, nearest
from tactile_rt.daemon.consumers import wanted_consumers
from tactile_rt.daemon.lock import lock_keys
from tactile_rt.drivers.codec import codec_class
from tactile_rt.drivers.opening import CanOptions, SerialOptions
from tactile_rt.recording.reader import MAGIC
from tactile_rt.settings import parse_options, take_options
from tactile_rt.sources.opening import ENTRY_POINTS, SCHEMES, opener
from tactile_rt.sources.synthetic import SyntheticOptions, SyntheticSource
from tactile_rt.stream import TactileError

__all__ = ["check_config"]

SHORTEST_TOKEN = 16  # of a page that others can reach
SCHEME_FILES = ("replay", "combined")
SIMULATED = ("sim", "whisking")
NPZ = b"PK"  # how it begins


def check_config(loaded: Loaded) -> None:
    """Raise `ConfigError` with file, line and key of whatever cannot be."""
    config = loaded.config
    _check_names(loaded, config)
    for i, source in enumerate(config.source):
        _check_url(loaded, i, source.url)
        if source.calibration:
            _try(loaded, ["source", i, "calibration"], load_calibration, source.calibration)
    _check_devices(loaded, config)
    for i, model in enumerate(config.model):
        if model.file and os.path.isdir(model.file):
            loaded.refuse(["model", i, "file"], f"{model.file} is a folder")
        if model.file:
            _try(loaded, ["model", i, "file"], load_model, Path(model.file))
        _try(loaded, ["model", i, "providers"], onnxruntime_names, model.providers)
        if model.every and model.mode != "sliding":
            loaded.refuse(["model", i, "every"], 'it is for mode = "sliding"')
    _check_tables(loaded, config)
    found = wanted_consumers(loaded)
    check_listeners(loaded, found)
    check_outputs(loaded, found)
    for wanted in found:
        try:
            wanted.make()
        except TactileError as error:
            table = wanted.name.partition(".")[0]
            path: list[str | int] = [table]
            if table == "publisher":
                names = [p.name for p in config.publisher]
                path.append(names.index(wanted.name.partition(".")[2]))
            loaded.refuse(path, str(error))


def _check_names(loaded: Loaded, config: Config) -> None:
    if not config.source:
        loaded.refuse(["source"], "there is no source: write [[source]] with a name and a url")
    names = [s.name for s in config.source]
    for i, name in enumerate(names):
        if name in names[:i]:
            loaded.refuse(["source", i, "name"], f"the name {name!r} is taken")
    for i, model in enumerate(config.model):
        if model.source not in names:
            loaded.refuse(
                ["model", i, "source"],
                f"no source {model.source!r}; {nearest(model.source, names)}",
            )


def _check_url(loaded: Loaded, i: int, url: str) -> None:
    path: list[str | int] = ["source", i, "url"]
    if not url.isprintable():
        loaded.refuse(path, f"{url!r:.80} holds what cannot be printed")
    try:
        parts = urlsplit(url, allow_fragments=False)
    except ValueError as error:
        loaded.refuse(path, f"{url!r}: {error}")
    schemes = sorted({*SCHEMES, *metadata.entry_points(group=ENTRY_POINTS).names})
    if parts.scheme not in schemes:
        near = nearest(parts.scheme or url, [f"{s}:" for s in schemes])
        loaded.refuse(path, f"{url!r:.80} is no source; {near}")
    target = unquote(parts.netloc + parts.path)
    pairs = parse_qsl(parts.query.replace("+", "%2B"), keep_blank_values=True)
    fields = dict(pairs)
    if len(fields) < len(pairs):
        loaded.refuse(path, "an option is given twice")
    try:
        _check_options(parts.scheme, target, fields)
    except TactileError as error:
        loaded.refuse(path, _in_words(str(error), fields))
    if parts.scheme in SCHEME_FILES and not os.path.isfile(target):
        loaded.refuse(path, f"no file {target}")
    if parts.scheme == "replay":
        try:
            with open(target, "rb") as file:
                begins = file.read(len(MAGIC))
        except OSError as error:
            loaded.refuse(path, f"{target}: {error.strerror}")
        if begins != MAGIC and not begins.startswith(NPZ):
            loaded.refuse(path, f"{target} is no recording: it is neither MCAP nor npz")


def _in_words(message: str, fields: dict[str, str]) -> str:
    """A mistake in the options of a URL, in a user's words."""
    found = re.search(r"Expected `(\w+)`.* - at `\$\.(\w+)`$", message)
    if not found:
        return message
    what, key = WORDS.get(found[1], found[1]), found[2]
    return f"{message[: found.start()]}{key}: expected {what}, got {fields.get(key, '')!r:.60}"


def _check_options(scheme: str, target: str, fields: dict[str, str]) -> None:
    if scheme == "synthetic":
        SyntheticSource(target, parse_options("source synthetic:", fields, SyntheticOptions))
    elif scheme not in SCHEMES or scheme in SIMULATED:
        options = getattr(opener(f"{scheme}:", scheme), "Options", None)
        if options is not None:
            parse_options(f"source {scheme}:", fields, options)
    if scheme not in ("serial", "can"):
        return
    if not target:
        raise TactileError(f"{scheme}: needs a port, e.g. serial:///dev/ttyUSB0?codec=bota")
    if "codec" not in fields:
        raise TactileError(
            f"{scheme}:{target} needs codec=...: what the device speaks, see `tactile-rt codecs`"
        )
    if scheme == "can":
        _check_bus(target)
    kind = codec_class(scheme, fields["codec"])
    line = SerialOptions if scheme == "serial" else CanOptions
    for made in take_options(f"{scheme}:{target}", fields, line, kind.Options):
        for field in dataclasses.fields(made):
            value = getattr(made, field.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise TactileError(f"{scheme}:{target}: {field.name}: {value} is no quantity")


def _check_bus(target: str) -> None:
    from can import VALID_INTERFACES

    interface, _, channel = target.partition(":")
    if not channel:
        raise TactileError(
            f"can:{target} needs an interface and a channel, e.g. can:socketcan:can0?codec=xela"
        )
    if interface not in VALID_INTERFACES:
        near = nearest(interface, sorted(VALID_INTERFACES))
        raise TactileError(f"can:{target}: no interface {interface!r}; {near}")


def _check_devices(loaded: Loaded, config: Config) -> None:
    """Two sources cannot share a device."""
    taken: dict[str, str] = {}
    for i, source in enumerate(config.source):
        for key in lock_keys(loaded.path, [source.url])[1:]:
            if key in taken:
                loaded.refuse(["source", i, "url"], f"source {taken[key]!r} has that {key}")
            taken[key] = source.name


def _check_tables(loaded: Loaded, config: Config) -> None:
    page, recorder, limits = config.page, config.recorder, config.limits
    if page is not None:
        check_host(loaded, ["page", "host"], page.host)
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
        check_folder(loaded, recorder.folder)
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


def _try(loaded: Loaded, path: list[str | int], check: Callable[[Any], Any], value: Any) -> None:
    try:
        check(value)
    except TactileError as error:
        loaded.refuse(path, str(error))
    except (OSError, ValueError) as error:  # a name that no file can have
        loaded.refuse(path, f"{value}: {error}")
