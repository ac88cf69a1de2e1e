"""What one key alone does not tell: whether a configuration as a whole can work.

Nothing is opened, and no device is asked; files that are named must be there.
"""

import ipaddress
import os
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from tactile_rt.calibration import load_calibration
from tactile_rt.daemon.config import Config
from tactile_rt.daemon.config_file import Loaded
from tactile_rt.daemon.config_tables import nearest
from tactile_rt.daemon.consumers import wanted_consumers
from tactile_rt.daemon.lock import lock_keys
from tactile_rt.drivers.codec import codec_class
from tactile_rt.drivers.opening import CanOptions, SerialOptions
from tactile_rt.drivers.synthetic import SyntheticOptions, SyntheticSource
from tactile_rt.model_file import load_model
from tactile_rt.options import parse_options, take_options
from tactile_rt.sources import ENTRY_POINTS, SCHEMES
from tactile_rt.stream import TactileError

__all__ = ["check_config"]

SHORTEST_TOKEN = 16  # of a page that others can reach
SCHEME_FILES = ("replay", "combined")


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
        if model.file:
            _try(loaded, ["model", i, "file"], load_model, Path(model.file))
    _check_tables(loaded, config)
    for wanted in wanted_consumers(loaded):
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
        loaded.refuse(path, str(error))
    if parts.scheme in SCHEME_FILES and not os.path.isfile(target):
        loaded.refuse(path, f"no file {target}")


def _check_options(scheme: str, target: str, fields: dict[str, str]) -> None:
    if scheme == "synthetic":
        SyntheticSource(target, parse_options("source synthetic:", fields, SyntheticOptions))
    if scheme not in ("serial", "can"):
        return
    if not target:
        raise TactileError(f"{scheme}: needs a port, e.g. serial:///dev/ttyUSB0?codec=bota")
    if "codec" not in fields:
        raise TactileError(
            f"{scheme}:{target} needs codec=...: what the device speaks, see `tactile-rt codecs`"
        )
    kind = codec_class(scheme, fields["codec"])
    line = SerialOptions if scheme == "serial" else CanOptions
    take_options(f"{scheme}:{target}", fields, line, kind.Options)


def _check_devices(loaded: Loaded, config: Config) -> None:
    """Two sources cannot share a device."""
    taken: dict[str, str] = {}
    for i, source in enumerate(config.source):
        for key in lock_keys(loaded.path, [source.url])[1:]:
            if key in taken:
                loaded.refuse(["source", i, "url"], f"source {taken[key]!r} has that {key}")
            taken[key] = source.name


def _check_tables(loaded: Loaded, config: Config) -> None:
    page, metrics, recorder, limits = config.page, config.metrics, config.recorder, config.limits
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
    if page is not None and metrics is not None and page.port == metrics.port:
        loaded.refuse(["metrics", "port"], f"{metrics.port} is the page's port")
    if recorder is not None:
        folder = Path(recorder.folder)
        if "\0" in recorder.folder or (folder.exists() and not folder.is_dir()):
            loaded.refuse(["recorder", "folder"], f"{recorder.folder!r} is not a folder")
        if 0 < recorder.rotate_mb < 1:
            loaded.refuse(["recorder", "rotate_mb"], "must be 0 (never) or at least 1")
        if 0 < recorder.rotate_s < 1:
            loaded.refuse(["recorder", "rotate_s"], "must be 0 (never) or at least 1")
        if recorder.mode == "trigger" and recorder.before_s + recorder.after_s == 0:
            loaded.refuse(
                ["recorder", "mode"], "a trigger with before_s = 0 and after_s = 0 keeps nothing"
            )
    if config.log.file and not Path(config.log.file).parent.is_dir():
        loaded.refuse(["log", "file"], f"no folder {Path(config.log.file).parent}")
    if limits.retry_last_s < limits.retry_first_s:
        loaded.refuse(["limits", "retry_last_s"], "must not be below retry_first_s")


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach what listens there."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _try(loaded: Loaded, path: list[str | int], check: Callable[[Any], Any], value: Any) -> None:
    try:
        check(value)
    except TactileError as error:
        loaded.refuse(path, str(error))
    except (OSError, ValueError) as error:  # a name that no file can have
        loaded.refuse(path, f"{value}: {error}")
