"""Open a source by its URL: ``scheme:target?option=value&option=value``.

Schemes are looked up in one table, imported when used, so that a robot without MuJoCo never
imports it; then among the entry points of group ``tactile_rt.sources``, where other packages add
theirs. What can be told of a URL without opening anything is told by `check_source`, in the words
of `open_source`: both go through `_prepared`.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module, metadata
from typing import Any

from tactile_rt.settings import nearest, parse_options, split_url
from tactile_rt.stream import ConfigError, Source

__all__ = ["ENTRY_POINTS", "SCHEMES", "check_source", "open_source"]

# scheme: (module, name, extra that it needs). The name is of a class of the target and an `Options`
# dataclass that it names, which may have a `check` of both for what can be told without opening; or
# of a function of the target and the options as written, which checks both and returns what opens.
SCHEMES = {
    "sim": ("tactile_rt.sim_backend.source", "SimSource", "sim"),
    "whisking": ("tactile_rt.sim_backend.whisking_source", "WhiskingSource", "sim"),
    "serial": ("tactile_rt.drivers.opening", "prepare_serial", ""),
    "can": ("tactile_rt.drivers.opening", "prepare_can", ""),
    "synthetic": ("tactile_rt.sources.synthetic", "SyntheticSource", ""),
    "replay": ("tactile_rt.recording.replay", "prepare_replay", "record"),
    "combined": ("tactile_rt.sources.combined", "prepare_combined", ""),
}
# Of other packages: a class as above, or a function of target and options that returns the source.
ENTRY_POINTS = "tactile_rt.sources"


def open_source(url: str) -> Source:
    """Open the source that a URL names.

    Raises:
        ConfigError: unknown scheme, unknown or ill-typed option, or an extra is not installed.
        SourceError: the device cannot be opened.
    """
    return _prepared(url, check=False)()


def check_source(url: str) -> None:
    """Refuse a URL that `open_source` would refuse whatever is plugged in; nothing is opened but
    the files that it names.

    Raises:
        ConfigError, RecordingError: as `open_source`, in the same words.
    """
    _prepared(url, check=True)


def _prepared(url: str, check: bool) -> Callable[[], Source]:
    scheme, target, fields = split_url(url)
    if scheme in SCHEMES:
        module, attribute, extra = SCHEMES[scheme]
        try:
            made: Any = getattr(import_module(module), attribute)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("tactile_rt"):
                raise
            raise ConfigError(
                f"source {scheme}: needs {error.name}, which is not installed: "
                f"pip install 'tactile-rt[{extra}]'"
            ) from None
        if not hasattr(made, "Options"):
            opens: Callable[[], Source] = made(target, fields)
            return opens
    else:
        made = _of_another_package(url, scheme)
    kind = getattr(made, "Options", None)
    if kind is None:
        return partial(made, target, fields)
    options = parse_options(f"{scheme}:{target}", fields, kind)
    if check and hasattr(made, "check"):
        made.check(target, options)
    return partial(made, target, options)


def _of_another_package(url: str, scheme: str) -> Any:
    points = metadata.entry_points(group=ENTRY_POINTS)
    for point in points.select(name=scheme):
        return point.load()
    known = sorted(f"{s}:" for s in {*SCHEMES, *points.names})
    near = nearest(f"{scheme}:" if scheme else url, known)
    raise ConfigError(f"{url!r:.80} is no source; {near}")
