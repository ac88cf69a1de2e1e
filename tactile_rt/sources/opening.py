"""Open a source by its URL: ``scheme:target?option=value&option=value``.

Schemes are looked up in one table, imported when used, so that a robot without MuJoCo never
imports it; then among what other packages add (`core.packages`). What can be told of a URL without
opening anything is told by `check_source`, in the words of `open_source`: both go through
`_prepared`.

One option is of every source: ``array=FILE`` says what array it is, by a file that `read_array`
reads. See `calibration.declare`.
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

# scheme: (module, name, extra that it needs). The name is of a class of the target and an `Options`
# dataclass that it names, which may have a `check` of both for what can be told without opening,
# the array for one; or of a function of the target and the options as written, which checks both
# and returns what opens.
SCHEMES = {
    "sim": ("tactile_rt.sim_backend.source", "SimSource", "sim"),
    "whisking": ("tactile_rt.sim_backend.whisking_source", "WhiskingSource", "sim"),
    "serial": ("tactile_rt.drivers.opening", "prepare_serial", ""),
    "can": ("tactile_rt.drivers.opening", "prepare_can", ""),
    "synthetic": ("tactile_rt.sources.synthetic", "SyntheticSource", ""),
    "replay": ("tactile_rt.recording.replay", "prepare_replay", ""),
    "combined": ("tactile_rt.sources.combined", "prepare_combined", ""),
}
ASKED = ("serial", "can")  # where a device may be asked what array it is, and so must be told


def open_source(url: str, *, calibration: str = "", array: str = "") -> Source:
    """Open the source that a URL names.

    Args:
        calibration: a file, or the id of a device calibrated before: corrects what the URL gives.
        array: a file of the array that the source then is, if the URL does not name one.

    Raises:
        ConfigError: unknown scheme, unknown or ill-typed option, or an extra is not installed.
        SourceError: the device cannot be opened.
        SpecMismatch: the calibration is of another device, or the source cannot be of the array.
    """
    return _prepared(url, calibration, array, check=False).open()


def check_source(url: str, *, calibration: str = "", array: str = "") -> ArraySpec | None:
    """Refuse a URL that `open_source` would refuse whatever is plugged in; nothing is opened but
    the files that it names.

    Returns:
        The array that the source will be of; None where only the device can tell.
    """
    return _prepared(url, calibration, array, check=True).spec


def is_made_up(url: str) -> bool:
    """Return whether nothing makes a URL's touches, so that decisions on them mean nothing."""
    return url.startswith("synthetic:")


def check_model(model: Path, url: str) -> None:
    """Refuse a model of another array than the URL's, where that is known beforehand."""
    from tactile_rt.classifier.model_file import fit_source, read_model

    card, spec = read_model(model)[0], check_source(url)
    if spec is None:
        return
    try:
        fit_source(model, card, spec)
    except SpecMismatch as error:
        raise SpecMismatch(f"{url}: {error}") from None


def _prepared(url: str, calibration: str, array: str, check: bool) -> Prepared:
    scheme, target, fields = split_url(url)
    if array and "array" in fields:
        raise ConfigError(f"{url}: the array is given twice: in the URL, and beside it")
    file = fields.pop("array", array)
    told = read_array(Path(file)) if file else None
    prepared = _of_scheme(url, scheme, target, fields, told, check)
    if calibration:
        prepared = prepared.calibrated(load_calibration(calibration))
    return prepared if told is None else prepared.declared(told)


def _of_scheme(
    url: str, scheme: str, target: str, fields: dict[str, str], told: ArraySpec | None, check: bool
) -> Prepared:
    if scheme in SCHEMES:
        module, attribute, extra = SCHEMES[scheme]
        with require_extra(f"source {scheme}: needs", extra):
            made: Any = getattr(import_module(module), attribute)
        if not hasattr(made, "Options"):
            further = {"array": told} if scheme in ASKED else {}
            prepared: Prepared = made(target, fields, **further)
            return prepared
    else:
        made = _of_another_package(url, scheme)
    kind = getattr(made, "Options", None)
    if kind is None:
        return Prepared(None, partial(made, target, fields))
    (options,) = take_options(f"{scheme}:{target}", fields, kind)
    spec = made.check(target, options) if check and hasattr(made, "check") else None
    return Prepared(spec, partial(made, target, options))


def _of_another_package(url: str, scheme: str) -> Any:
    found = packages.added(packages.SOURCES, scheme)
    if found is not None:
        return found
    known = sorted(f"{s}:" for s in {*SCHEMES, *packages.added_names(packages.SOURCES)})
    near = nearest(f"{scheme}:" if scheme else url, known)
    raise ConfigError(f"{url!r:.80} is no source; {near}")
