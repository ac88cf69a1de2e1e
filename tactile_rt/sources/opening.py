"""Open a source by its URL: ``scheme:target?option=value&option=value``.

Schemes are looked up in one table, imported when used, so that a robot without MuJoCo never
imports it; then among the entry points of group ``tactile_rt.sources``, where other packages add
theirs.
"""

import difflib
from importlib import import_module, metadata
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from tactile_rt.settings import parse_options
from tactile_rt.stream import ConfigError, Source

__all__ = ["ENTRY_POINTS", "SCHEMES", "open_source", "opener"]

# scheme: (module, what opens it, extra that it needs). What opens it is a function of the target
# and the options as written, or a class of the target and an `Options` dataclass that it names.
SCHEMES = {
    "sim": ("tactile_rt.sim_backend.source", "SimSource", "sim"),
    "whisking": ("tactile_rt.sim_backend.whisking_source", "WhiskingSource", "sim"),
    "serial": ("tactile_rt.drivers.opening", "open_serial", ""),
    "can": ("tactile_rt.drivers.opening", "open_can", ""),
    "synthetic": ("tactile_rt.sources.synthetic", "SyntheticSource", ""),
    "replay": ("tactile_rt.recording.replay", "open_replay", "record"),
    "combined": ("tactile_rt.sources.combined", "open_combined", ""),
}
ENTRY_POINTS = "tactile_rt.sources"


def open_source(url: str) -> Source:
    """Open the source that a URL names.

    Raises:
        ConfigError: unknown scheme, unknown or ill-typed option, or an extra is not installed.
        SourceError: the device cannot be opened.
    """
    try:
        parts = urlsplit(url, allow_fragments=False)  # a file's name may hold a #
    except ValueError as error:
        raise ConfigError(f"source {url!r}: {error}") from None
    # A + is a +, as in a file's name, not the space that web forms make of it.
    pairs = parse_qsl(parts.query.replace("+", "%2B"), keep_blank_values=True)
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ConfigError(f"source {url!r}: an option is given twice")
    make = opener(url, parts.scheme)
    target = unquote(parts.netloc + parts.path)
    options = getattr(make, "Options", None)
    if options is not None:
        fields = parse_options(f"source {parts.scheme}:", fields, options)
    source: Source = make(target, fields)
    return source


def opener(url: str, scheme: str) -> Any:
    """What opens sources of a scheme: see `SCHEMES`.

    Args:
        url: for the message.
        scheme: without the colon.

    Raises:
        ConfigError: unknown scheme, or an extra is not installed.
    """
    if scheme in SCHEMES:
        module, attribute, extra = SCHEMES[scheme]
        try:
            return getattr(import_module(module), attribute)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("tactile_rt"):
                raise
            raise ConfigError(
                f"source {scheme}: needs {error.name}, which is not installed: "
                f"pip install 'tactile-rt[{extra}]'"
            ) from None
    for point in metadata.entry_points(group=ENTRY_POINTS, name=scheme):
        return point.load()
    known = sorted({*SCHEMES, *metadata.entry_points(group=ENTRY_POINTS).names})
    near = difflib.get_close_matches(scheme or url, known, 1)
    raise ConfigError(
        f"unknown source {url!r}: it begins with one of {', '.join(k + ':' for k in known)}"
        + (f" (did you mean {near[0]}:?)" if near else "")
    )
