"""Which engine runs a model on this machine, as `tactile-rt model bench --engines` measured it.

Kept in $XDG_STATE_HOME/tactile_rt/engines.json, else ~/.local/state/tactile_rt/engines.json, by the
model's hash and the processor, with the releases of the engines that were compared. Where nothing
is kept, or what is kept is of no use, onnxruntime runs the model: a file can make a robot slower,
never stop it.
"""

import hashlib
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import msgspec

from tactile_rt.classifier.engines import DEFAULT, ENGINES, check_engine
from tactile_rt.classifier.model_file import hash_of
from tactile_rt.errors import ConfigError
from tactile_rt.files import open_regular, write_whole

__all__ = ["EngineChoice", "KeptEngine", "choices_file", "choose_engine", "keep_engine"]

LARGEST = 1 << 20  # bytes of the file; a choice takes 300
MOST = 1000  # choices in it: the oldest go
ANEW = "`tactile-rt model bench MODEL --engines` chooses anew"
PLAIN = ("cpu",)  # providers of who has not asked for any


class KeptEngine(msgspec.Struct, frozen=True):
    """A choice as it is kept.

    Attributes:
        engine: The name of the engine.
        versions: The release of each package that an engine of this machine had, by its name.
        step_ms: The median CPU time of a step, ms.
    """

    engine: str
    versions: dict[str, str]
    step_ms: float


class _File(msgspec.Struct, frozen=True):
    version: int
    choices: dict[str, KeptEngine]


class EngineChoice(msgspec.Struct, frozen=True):
    """Which engine is to run a model, and why.

    Attributes:
        engine: The name of the engine.
        kept: Whether the engine was measured and kept, rather than asked for or the default.
        remark: The reason, a line, for which what was kept is of no use; else empty.
    """

    engine: str
    kept: bool = False
    remark: str = ""


def choose_engine(model: Path, asked: str = "", providers: Sequence[str] = PLAIN) -> EngineChoice:
    """The engine that was asked for; else what is kept for this model and machine.

    Args:
        model: the ``.onnx`` file.
        asked: name of an engine; empty: none was asked for.
        providers: execution providers that were asked for; other than the CPU's are onnxruntime's.

    Raises:
        ConfigError: the engine that was asked for is not there, or has no such providers.
    """
    if asked:
        if check_engine(asked) != DEFAULT and tuple(providers) != PLAIN:
            raise ConfigError(
                f"engine {asked!r} has no execution providers: {', '.join(providers)} are of "
                "onnxruntime"
            )
        return EngineChoice(asked)
    if tuple(providers) != PLAIN:
        return EngineChoice(DEFAULT)
    if not model.is_file():  # nothing is kept for it, and whoever opens it tells
        return EngineChoice(DEFAULT)
    try:
        found = _read().get(_key(model))
    except (OSError, msgspec.MsgspecError, ValueError) as error:
        said = error.strerror if isinstance(error, OSError) else "it is damaged"
        return _plain(f"{choices_file()} cannot be read ({said}): {ANEW}")
    if found is None or found.engine == DEFAULT:
        return EngineChoice(DEFAULT, kept=found is not None)
    if found.engine not in ENGINES:
        return _plain(f"engine {found.engine!r}, kept for {model.name}, is not known: {ANEW}")
    if not ENGINES[found.engine].version:
        return _plain(f"engine {found.engine!r}, kept for {model.name}, is not installed: {ANEW}")
    if found.versions != _versions():
        return _plain(
            f"engine {found.engine!r} was kept for {model.name} by other releases: {ANEW}"
        )
    return EngineChoice(found.engine, kept=True)


def keep_engine(model: Path, engine: str, step_ms: float) -> Path:
    """Keep a choice for this model and machine.

    Args:
        model: the ``.onnx`` file.
        engine: name of the engine.
        step_ms: median CPU time of a step, ms.

    Returns:
        The file that it was written to. What it held is lost if it could not be read.

    Raises:
        ConfigError: it cannot be written; one line.
    """
    path = choices_file()
    if path is None:
        raise ConfigError("there is no home folder to keep it in: set XDG_STATE_HOME")
    try:
        choices = _read()
    except (OSError, msgspec.MsgspecError, ValueError):
        choices = {}
    key = _key(model)
    choices.pop(key, None)
    choices = dict(list(choices.items())[-(MOST - 1) :])
    choices[key] = KeptEngine(engine, _versions(), round(step_ms, 4))
    written = msgspec.json.format(msgspec.json.encode(_File(1, choices))) + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_fifo():  # which would be written into, as soon as somebody reads
            path.unlink()
        write_whole(path, lambda file: file.write(written))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from None
    return path


def choices_file() -> Path | None:
    """Where choices are kept; None: this user has no home folder."""
    stated = os.environ.get("XDG_STATE_HOME", "")
    if not os.path.isabs(stated):
        try:
            stated = str(Path.home() / ".local" / "state")
        except RuntimeError:
            return None
    return Path(stated) / "tactile_rt" / "engines.json"


def _plain(remark: str) -> EngineChoice:
    return EngineChoice(DEFAULT, remark=f"{remark}; onnxruntime runs it")


def _read() -> dict[str, KeptEngine]:
    path = choices_file()
    if path is None:
        return {}
    try:
        with open_regular(path) as file:
            data = file.read(LARGEST + 1)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    if len(data) > LARGEST:
        raise ValueError
    found = msgspec.json.decode(data, type=_File)
    if found.version != 1:
        raise ValueError
    return found.choices


def _key(model: Path) -> str:
    return f"{hash_of(model)} on {_processor()}"


def _versions() -> dict[str, str]:
    found = {engine.package: engine.version for engine in ENGINES.values()}
    return {package: version for package, version in found.items() if version}


def _processor() -> str:
    """What tells apart processors that compute at other speeds: name, and instructions."""
    names = ("model name", "CPU part", "flags", "Features")  # of x86-64, aarch64
    found: dict[str, str] = {}
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() in names:
            found.setdefault(key.strip(), value.strip())
    told = hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()[:8]
    return f"{found.get('model name') or platform.machine()} {told}"
