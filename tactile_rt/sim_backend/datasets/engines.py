"""Engines that work through a list of names: processes of this machine, or a Ray cluster.

Work is a function of an object's name that writes its result to a file and can be repeated: after
a kill, finished work is not done again.
"""

import multiprocessing
import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from tactile_rt.core.errors import ConfigError, TactileError
from tactile_rt.core.packages import require_extra

ENGINES = ("processes", "ray")
PATIENCE_S = 10
TRIES = 3  # of an object whose process died
DIED = f"the process that made it died {TRIES} times (out of memory?)"

Work = Callable[[str], str | None]  # a name -> the reason of a failure, or None on success
Outcome = tuple[str, str | None]  # the name, and the work's answer


def run_processes(work: Work, names: Sequence[str], processes: int) -> Iterator[Outcome]:
    """Call `work` on every name in parallel processes; yield each outcome when ready.

    An exception in the work ends the run and is raised here. A process that dies is replaced, and
    its name is tried again, up to 3 times in all. Closing the iterator kills the processes.

    Args:
        work: must be picklable.
        processes: at least 1.
    """
    waiting = deque((name, 1) for name in names)
    busy: dict[Connection, tuple[SpawnProcess, str, int]] = {}
    idle: list[tuple[Connection, SpawnProcess]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < processes:
                connection, process = idle.pop() if idle else _start(work)
                name, tries = waiting.popleft()
                busy[connection] = (process, name, tries)
                with suppress(OSError):  # it died while idle: the read below notices
                    connection.send(name)
            for ready in wait(list(busy)):
                assert isinstance(ready, Connection)
                process, name, tries = busy.pop(ready)
                try:
                    outcome = ready.recv()
                except (EOFError, OSError):
                    ready.close()
                    process.join()
                    if tries < TRIES:
                        waiting.appendleft((name, tries + 1))
                    else:
                        yield name, DIED
                    continue
                idle.append((ready, process))
                if isinstance(outcome, BaseException):
                    raise outcome
                yield name, outcome
    finally:
        left = [process for process, _, _ in busy.values()] + [process for _, process in idle]
        for process in left:
            process.kill()
        for process in left:
            process.join()


def _start(work: Work) -> tuple[Connection, SpawnProcess]:
    # spawn: a forked copy of a process that runs threads (a progress bar) may hang.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(work, theirs), daemon=True)
    # First, since a start of the tracker unblocks the signals that are blocked below.
    resource_tracker.ensure_running()
    # Only this process handles Ctrl-C: the others must not receive it, even while they start.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _limit_threads():
            process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    theirs.close()  # or its end would seem open after the process has died
    return ours, process


@contextmanager
def _limit_threads() -> Iterator[None]:
    """Limit processes started in this context to one thread: every core has a process."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _serve(work: Work, connection: Connection) -> None:
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            name = connection.recv()
        except EOFError:
            return
        try:
            outcome: str | BaseException | None = work(name)
        except Exception as error:
            outcome = error
        connection.send(outcome)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def run_ray(
    work: Work, names: Sequence[str], processes: int | None = None, address: str | None = None
) -> Iterator[Outcome]:
    """Call `work` on every name on a Ray cluster; yield each outcome when ready.

    A task whose worker or node is lost is tried again elsewhere.

    Args:
        work: must be picklable; runs on any node, so the files that it writes must be on a file
            system that all nodes share.
        processes: number of tasks at a time; if None, one per CPU of the cluster.
        address: HOST:PORT of the cluster; if None, the cluster that RAY_ADDRESS names or that runs
            on this machine, or else a new one of this machine alone.

    Raises:
        ConfigError: Ray is not installed, or no cluster answers at the address.
    """
    with require_extra("this needs", "cluster"):
        import ray
    started = not ray.is_initialized()
    if started:
        _join_cluster(ray, address, processes)
    try:
        at_once = processes or max(
            int(sum(n["Resources"].get("CPU", 0) for n in ray.nodes() if n["Alive"])), 1
        )
        task = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_call)
        stored = ray.put(work)
        waiting: deque[str] = deque(names)
        running: dict[Any, str] = {}
        while waiting or running:
            while waiting and len(running) < at_once:
                name = waiting.popleft()
                running[task.remote(stored, name)] = name
            (ready, *_), _ = ray.wait(list(running))
            name = running.pop(ready)
            try:
                yield name, ray.get(ready)
            except ray.exceptions.WorkerCrashedError:
                yield name, DIED
            except ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, TactileError | OSError):
                    raise error.cause from None
                raise
    finally:
        if started:
            ray.shutdown()


def _join_cluster(ray: Any, address: str | None, processes: int | None) -> None:
    options = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}
    here = {"num_cpus": processes} if processes else {}
    try:
        if address == "local":
            ray.init(address="local", **here, **options)
        elif address is not None:
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), PATIENCE_S).close()  # Ray tries for ever
            ray.init(address=address, **options)
        else:
            try:
                ray.init(address="auto", **options)
            except ConnectionError:
                ray.init(address="local", **here, **options)
    except (OSError, ValueError) as error:
        why = "give its HOST:PORT" if isinstance(error, ValueError) else error
        raise ConfigError(f"no Ray cluster at {address or 'this machine'}: {why}") from None


def _call(work: Work, name: str) -> str | None:
    return work(name)
