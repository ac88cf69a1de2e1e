"""Opening of sources by URL: ``scheme:target?option=value&option=value``.

Schemes are looked up in one table, whose modules are imported when used, so that a robot without
MuJoCo never imports it; then among those of other packages (`core.packages`). `check_source` finds
errors in a URL without opening anything, with the messages of `open_source`: both use
`_prepare_source`.

Every source has the option ``array=FILE``, which declares it to be of an array, by a file that
`read_array` reads. See `calibration.declare`.
"""

from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from tactile_rt.calibration import load_calibration
from tactile_rt.classifier.array_file import read_array
from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError, SpecMismatch
from tactile_rt.core.packages import require_extra
from tactile_rt.core.settings import nearest, split_url, take_options
from tactile_rt.core.stream import ArraySpec, Source
from tactile_rt.drivers.opening import Prepared

# scheme: (module, name, needed extra). The name is that of a class, constructed from the target and
# its dataclass `Options`; its `check`, if any, has these arguments and returns the array without
# opening. Or the name is that of a function of the target and the options as text, which checks
# both and returns a `Prepared`.
SCHEMES = {
    "sim": ("tactile_rt.sim_backend.source", "SimSource", "sim"),
    "whisking": ("tactile_rt.sim_backend.whisking_source", "WhiskingSource", "sim"),
    "serial": ("tactile_rt.drivers.opening", "prepare_serial", ""),
    "can": ("tactile_rt.drivers.opening", "prepare_can", ""),
    "synthetic": ("tactile_rt.sources.synthetic", "SyntheticSource", ""),
    "replay": ("tactile_rt.recording.replay", "prepare_replay", ""),
    "combined": ("tactile_rt.sources.combined", "prepare_combined", ""),
}
ASKED = ("serial", "can")  # schemes that take the declared array, as they may query the device


def open_source(url: str, *, calibration: str = "", array: str = "") -> Source:
    """Open the source that a URL names.

    Args:
        calibration: file, or id of a device, whose calibration is applied to the samples.
        array: file of the array that the source is declared to be, if the URL names none.

    Raises:
        ConfigError: unknown scheme, unknown or ill-typed option, or an extra is not installed.
        SourceError: the device cannot be opened.
        SpecMismatch: the calibration is of another device, or the source cannot be of the array.
    """
    return _prepare_source(url, calibration, array, check=False).open()


def check_source(url: str, *, calibration: str = "", array: str = "") -> ArraySpec | None:
    """Check a URL without opening a device; return the source's array. Refuse what `open_source`
    would refuse with any device. Only files that the URL names are opened.

    Returns:
        The array of the source, or None if only the device knows it.
    """
    return _prepare_source(url, calibration, array, check=True).spec


def is_made_up(url: str) -> bool:
    """Return whether a URL's touches are artificial, so that decisions on them mean nothing."""
    return url.startswith("synthetic:")


def check_model(model: Path, url: str) -> None:
    """Refuse a model whose array differs from the URL's, if the URL's is known."""
    from tactile_rt.classifier.model_file import fit_source, read_model

    card, spec = read_model(model)[0], check_source(url)
    if spec is None:
        return
    try:
        fit_source(model, card, spec)
    except SpecMismatch as error:
        raise SpecMismatch(f"{url}: {error}") from None


def _prepare_source(url: str, calibration: str, array: str, check: bool) -> Prepared:
    scheme, target, fields = split_url(url)
    if array and "array" in fields:
        raise ConfigError(f"{url}: the array is given twice: in the URL and separately")
    file = fields.pop("array", array)
    spec = read_array(Path(file)) if file else None
    prepared = _prepare_scheme(url, scheme, target, fields, spec, check)
    if calibration:
        prepared = prepared.with_calibration(load_calibration(calibration))
    return prepared if spec is None else prepared.with_array(spec)


def _prepare_scheme(
    url: str, scheme: str, target: str, fields: dict[str, str], array: ArraySpec | None, check: bool
) -> Prepared:
    if scheme in SCHEMES:
        module, attribute, extra = SCHEMES[scheme]
        with require_extra(f"source {scheme}: needs", extra):
            made: Any = getattr(import_module(module), attribute)
        if not hasattr(made, "Options"):
            further = {"array": array} if scheme in ASKED else {}
            prepared: Prepared = made(target, fields, **further)
            return prepared
    else:
        made = _find_added_source(url, scheme)
    kind = getattr(made, "Options", None)
    if kind is None:
        return Prepared(None, partial(made, target, fields))
    (options,) = take_options(f"{scheme}:{target}", fields, kind)
    spec = made.check(target, options) if check and hasattr(made, "check") else None
    return Prepared(spec, partial(made, target, options))


def _find_added_source(url: str, scheme: str) -> Any:
    found = packages.import_addition(packages.SOURCES, scheme)
    if found is not None:
        return found
    known = sorted(f"{s}:" for s in {*SCHEMES, *packages.added_names(packages.SOURCES)})
    near = nearest(f"{scheme}:" if scheme else url, known)
    raise ConfigError(f"{url!r:.80} is no source; {near}")
