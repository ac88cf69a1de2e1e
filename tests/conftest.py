import faulthandler
import gc
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

# Before numpy, torch and onnxruntime start their pools: on a shared machine more threads than one
# make small tests slower, not faster.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Dozens of children import the package: they need not compile it, whatever the shell says.
os.environ["PYTHONDONTWRITEBYTECODE"] = ""

# What this machine's user has measured and kept decides nothing here.
os.environ["XDG_STATE_HOME"] = os.path.join(tempfile.gettempdir(), "tactile_rt-tests-keep-nothing")

import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from hypothesis import settings

from tests.helpers.waiting import until

sys.dont_write_bytecode = False

# No deadline: another process on the machine must not fail a test. Derandomised: whoever runs the
# tests gets the same examples, so a pass stays a pass.
settings.register_profile("tactile_rt", deadline=None, derandomize=True)
settings.load_profile("tactile_rt")


# Until all tests are collected; see `pytest_collection_finish`.
gc.disable()

# What the extras bring: tests that import one which is not installed are skipped.
EXTRAS = frozenset(
    "DracoPy PIL av cantools cyclonedds foxglove gymnasium h5py lightning manifold3d matplotlib "
    "mujoco numba onnx onnxscript pyarrow ray rosbags scipy sklearn threadpoolctl torch trimesh "
    "mcap_ros2 pynwb urllib3 yaml zenoh zmq".split()
)


class Module(pytest.Module):
    """A file of tests, which needs the packages that it imports."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        try:
            return super().collect()
        except self.CollectError as error:
            match error.__cause__:
                case ModuleNotFoundError(name=str(name)) if name.partition(".")[0] in EXTRAS:
                    pytest.skip(f"{name} is not installed", allow_module_level=True)
            raise


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> Module:
    """Make what `Module` says of a file of tests."""
    return Module.from_parent(parent, path=module_path)


LENGTHY = Path(__file__).with_name("lengthy.txt")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that take more than their share of a quick look; see the file."""
    lines = LENGTHY.read_text("utf-8").splitlines()
    names = tuple(line for line in lines if line and not line.startswith("#"))
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(names):
            item.add_marker(pytest.mark.lengthy)


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but never look at the thousands of tests again."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Set the limit to hanging anew, which pytest takes away from a test that has failed."""
    limit = float(item.config.getini("faulthandler_timeout"))
    if limit:
        file = item.config.stash[fault_handler_stderr_fd_key]
        faulthandler.dump_traceback_later(limit, file=file, exit=True)


@pytest.fixture
def no_thread_left() -> Iterator[None]:
    """Fail a test that leaves a thread behind."""
    before = _threads()
    yield
    # a progress bar tells its thread to end, and does not wait for it
    until(lambda: _threads() <= before)


def _threads() -> set[threading.Thread]:
    # tqdm keeps one thread for the bars of whoever imports it, and renews it
    return {t for t in threading.enumerate() if type(t).__name__ != "TMonitor"}


@pytest.fixture
def cwd(tmp_path, monkeypatch):
    """A folder of the test's own, which it is in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def call(capsys, monkeypatch):
    """Call `tactile-rt` in this process with these arguments: (exit code, stdout, stderr).

    A message that must be cut to its longest fails the test: it is to be written shorter.
    """
    from tactile_rt.cli import main, tables
    from tactile_rt.core import errors

    def check_length(message, shorten=errors.shorten):
        assert errors.length(message) <= errors.LONGEST, f"{errors.length(message)}: {message}"
        return shorten(message)

    monkeypatch.setattr(errors, "shorten", check_length)

    # A slow machine must not add lines of progress to what a test expects on stderr.
    monkeypatch.setattr(tables, "LINE_S", threading.TIMEOUT_MAX)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["tactile-rt", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code or 0, *capsys.readouterr()

    handlers = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    yield run
    for number, handler in handlers.items():  # a daemon takes them for good
        signal.signal(number, handler)


@pytest.fixture
def done(call):
    """Call `tactile-rt` with these arguments, expect exit code 0, return stdout and stderr."""

    def run(*arguments):
        code, out, err = call(*arguments)
        assert code == 0, err
        return out, err

    return run


@pytest.fixture
def refused(call):
    """Call `tactile-rt` with these arguments, expect one line on stderr and no more, return it."""

    def run(*arguments):
        code, out, err = call(*arguments)
        assert (code, out) == (2, "")
        assert err.startswith("tactile-rt: ")
        assert err.count("\n") == 1, err
        return err

    return run
