"""Open a source by its URL: ``scheme:target?option=value&option=value``.

Schemes are looked up in one table, imported when used, so that a robot without MuJoCo never
imports it; then among the entry points of group ``tactile_rt.sources``, where other packages add
theirs.
"""

import difflib
from importlib import import_module, metadata
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

import msgspec

from tactile_rt.stream import ConfigError, Source

__all__ = ["open_source"]

# scheme: (module, source class, options dataclass, extra that it needs)
SCHEMES = {"sim": ("tactile_rt.sim_backend.source", "SimSource", "SimOptions", "sim")}
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
    scheme = parts.scheme
    # A + is a +, as in a file's name, not the space that web forms make of it.
    pairs = parse_qsl(parts.query.replace("+", "%2B"), keep_blank_values=True)
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ConfigError(f"source {url!r}: an option is given twice")
    make, options = _lookup(url, scheme)
    known = options.__dataclass_fields__
    for name in fields:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]}?" if near else f"; it takes {', '.join(known)}"
            raise ConfigError(f"source {scheme}: has no option {name!r}{hint}")
    try:
        chosen = msgspec.convert(fields, options, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(f"source {url!r}: {error}") from None
    source: Source = make(unquote(parts.netloc + parts.path), chosen)
    return source


def _lookup(url: str, scheme: str) -> tuple[Any, Any]:
    if scheme in SCHEMES:
        module, source, options, extra = SCHEMES[scheme]
        try:
            there = import_module(module)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("tactile_rt"):
                raise
            raise ConfigError(
                f"source {scheme}: needs {error.name}, which is not installed: "
                f"pip install 'tactile-rt[{extra}]'"
            ) from None
        return getattr(there, source), getattr(there, options)
    for point in metadata.entry_points(group=ENTRY_POINTS, name=scheme):
        made = point.load()
        return made, made.Options
    known = sorted({*SCHEMES, *metadata.entry_points(group=ENTRY_POINTS).names})
    near = difflib.get_close_matches(scheme or url, known, 1)
    raise ConfigError(
        f"unknown source {url!r}: it begins with one of {', '.join(k + ':' for k in known)}"
        + (f" (did you mean {near[0]}:?)" if near else "")
    )
