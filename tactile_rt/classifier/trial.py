"""Trial runs of model files, in a child process with limits on memory and time.

`onnx_check` judges a file by its contents; its cost shows only when it runs. Computed shapes can
ask for any memory, and a graph of a few kilobytes for hours. So before a daemon, which has samples
to lose, loads a file, a child process runs it, with limits on memory, processor time and duration.
The child dies with its parent.

    try_model(path, Limits) -> Trial        in the parent
    python -m tactile_rt.classifier.trial   the child: settings as JSON in, result as JSON out
"""

import ctypes
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from tactile_rt.core.errors import ModelError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tactile_rt.classifier.model_card import ModelCard

MB = 1_000_000
LOOK_S = 0.02  # how often the parent checks the child and `stopped`
CPU_S = 2  # beyond the limit on duration: threads of onnxruntime may share the work
STEPS = 5  # at least, of a touch and at rest, after the warm-up
EXTREME_STEPS = 3  # of each of the loads that no touch makes
TOUCH_S = 1.0  # a touch ends after this time, once it has had the least number of steps
PR_SET_PDEATHSIG = 1
WANTED_MEMORY = ("bad_alloc", "Failed to allocate", "BFCArena", "bad allocation")
MESSAGE = 400  # characters


class TrialLimits(msgspec.Struct, frozen=True):
    """The limits of a trial.

    Attributes:
        memory_mb: The memory beyond four times the file's size, in MB.
        seconds: The time to load, to warm up and to run all steps, s.
    """

    memory_mb: float = 256.0
    seconds: float = 60.0


class Trial(msgspec.Struct, frozen=True):
    """The result of a trial: the time and memory that a model needed.

    Attributes:
        sha256: The hash of the bytes that were tried, hexadecimal.
        load_s: The time to load and to warm up, s.
        step_s: The median time of a step, s, for the slowest of rest, touch and extreme loads.
        memory_mb: The memory in use at the end, in MB.
    """

    sha256: str
    load_s: float
    step_s: float
    memory_mb: float


class _Task(msgspec.Struct, frozen=True):
    path: str
    every: int  # steps between sliding windows; 0: no sliding windows
    limits: TrialLimits
    parent: int = 0  # process id of the parent; 0: any


class _Refusal(msgspec.Struct, frozen=True):
    refused: str


def try_model(
    path: Path,
    limits: TrialLimits | None = None,
    every: int = 0,
    stopped: Callable[[], bool] = lambda: False,
) -> Trial:
    """Load, warm up and run a model in a child process; return time and memory.

    Args:
        path: The ``.onnx`` file, of kind ``step``.
        limits: The limits on memory and time, or None for the defaults.
        every: The steps between sliding windows, which determine the number of lanes; 0 for one.
        stopped: Returns True once the result is no longer needed; called repeatedly.

    Raises:
        ModelError: One line: what is wrong with the file, or which limit it broke.
    """
    limits = limits or TrialLimits()
    task = _Task(str(path), every, limits, os.getpid())
    child = subprocess.Popen(
        [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, close_fds=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )  # fmt: skip
    assert child.stdin is not None and child.stdout is not None
    try:
        child.stdin.write(msgspec.json.encode(task))
        child.stdin.close()
        until = time.monotonic() + limits.seconds
        while child.poll() is None:
            if stopped():
                raise ModelError(f"{path}: its trial was abandoned")
            if time.monotonic() > until:
                raise ModelError(
                    f"{path} is refused: more than limits.model_s = {limits.seconds:g} s to load "
                    "and warm up"
                )
            time.sleep(LOOK_S)
        return _read_result(path, limits, child.returncode, child.stdout.read())
    except BrokenPipeError:
        raise ModelError(f"{path} is refused: its trial could not begin") from None
    finally:
        child.kill()
        child.wait()
        child.stdout.close()


def _read_result(path: Path, limits: TrialLimits, code: int, output: bytes) -> Trial:
    try:
        found = msgspec.json.decode(output, type=dict)
    except msgspec.MsgspecError:
        found = {}
    if "refused" in found:
        raise ModelError(found["refused"])
    if code == 0 and found:
        return msgspec.convert(found, Trial)
    if -code == signal.SIGXCPU:
        why = f"more than limits.model_s = {limits.seconds:g} s of the processor"
    elif code < 0 or code == MEMORY:
        why = _explain_memory(limits)
    else:
        why = f"its trial ended with exit code {code}"
    raise ModelError(f"{path} is refused: {why}")


def _explain_memory(limits: TrialLimits) -> str:
    return (
        f"it needs more memory than limits.model_mb = {limits.memory_mb:g} MB and four times its "
        "size, breaks onnxruntime, or was killed"
    )


# the child

MEMORY = 77  # its exit code when memory ran out


def _run_task(task: _Task) -> Trial:
    import numpy as np

    from tactile_rt.classifier.decision_rules import Lanes
    from tactile_rt.classifier.model_file import hash_of, load_model
    from tactile_rt.classifier.stepper import Stepper

    path, limits = Path(task.path), task.limits
    before = _read_data_bytes()
    size = path.stat().st_size if path.is_file() else 0
    most = before + round(limits.memory_mb * MB) + 4 * size
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    cpu = round(limits.seconds) + CPU_S
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sha256 = hash_of(path)
    began = time.monotonic()
    session, card = load_model(path)
    every = min(task.every, card.steps) or card.steps
    stepper = Stepper(session, card, Lanes(card.steps, every).count)
    load_s = time.monotonic() - began
    step_s, random = 0.0, np.random.default_rng(0)
    shape = stepper.samples.shape[1:]
    floor = np.broadcast_to(card.floor, shape[1:])
    for name, decides, loads in _list_loads(card):
        stepper.begin(3 * floor, 2 * floor)  # some offset, and noise above the least
        began = time.monotonic()
        took: list[float] = []
        for load in loads:
            if len(took) >= STEPS and time.monotonic() - began > TOUCH_S:
                break
            stepper.samples[:] = 3 * floor + load * random.uniform(0.9, 1.0, shape)
            start = time.monotonic()
            logits = stepper.run()
            took.append(time.monotonic() - start)
            if decides and not np.isfinite(logits).all():
                raise ModelError(f"{path} is refused: its logits for {name} are not finite")
        step_s = max(step_s, float(np.median(took)))
    return Trial(sha256, load_s, step_s, (_read_data_bytes() - before) / MB)


def _list_loads(card: "ModelCard") -> list[tuple[str, bool, "NDArray[np.float64]"]]:
    """List the loads that a model is tried on.

    Each is a name, whether the answer must be finite, and loads (step, element, channel), SI, which
    rise and fall as in a touch, derived from the card.
    """
    import numpy as np

    from tactile_rt.classifier.classifier import ABSURD, IMPLAUSIBLE

    random = np.random.default_rng(0)
    touch = np.array(card.clip) * random.uniform(0.2, 1.0, card.array.shape)
    signs = random.choice((-1.0, 1.0), card.array.shape)
    largest = IMPLAUSIBLE * np.array(card.clip)
    limit = float(np.finfo(np.float32).max)
    tried: list[tuple[str, bool, int, NDArray[np.float64]]] = [
        ("rest", True, STEPS, 0 * signs),
        ("a touch", True, max(STEPS, card.steps), touch),
        ("the largest loads", True, EXTREME_STEPS, largest * signs),
        ("absurd loads", False, EXTREME_STEPS, ABSURD * signs),
        ("float32's limits", False, EXTREME_STEPS, limit * signs),
        ("no numbers", False, EXTREME_STEPS, np.nan * signs),
        ("infinite loads", False, EXTREME_STEPS, np.inf * signs),
    ]
    return [
        (name, decides, np.sin(np.pi * (np.arange(n) + 0.5) / n)[:, None, None] * load)
        for name, decides, n, load in tried
    ]


def _read_data_bytes() -> int:
    """Return the memory that counts against RLIMIT_DATA, bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return 1024 * int(line.split()[1])
    return 0


def _main() -> int:
    if sys.platform == "linux":
        with suppress(OSError):  # if memory runs out, the kernel kills this process first
            Path("/proc/self/oom_score_adj").write_text("1000")
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches it too: the parent decides
    task = msgspec.json.decode(sys.stdin.buffer.read(), type=_Task)
    if task.parent not in (0, os.getppid()):  # the parent died before prctl
        return 1
    os.nice(5)  # running parts come first
    try:
        result: Trial | _Refusal = _run_task(task)
    except ModelError as error:
        result = _Refusal(_rewrite_error(str(error), task))
    except MemoryError:
        return MEMORY
    except Exception as error:  # onnxruntime raises a dozen unrelated types
        text = " ".join(str(error).split())
        result = _Refusal(_rewrite_error(f"{task.path} is refused: it cannot be run: {text}", task))
    sys.stdout.buffer.write(msgspec.json.encode(result))
    sys.stdout.flush()
    os._exit(0)  # onnxruntime may need more memory to clean up


def _rewrite_error(text: str, task: _Task) -> str:
    """Shorten a failed trial's error; if memory ran out, name the memory limit instead."""
    if any(word in text for word in WANTED_MEMORY):
        return f"{task.path} is refused: {_explain_memory(task.limits)}"
    return text[:MESSAGE]


if __name__ == "__main__":
    sys.exit(_main())
