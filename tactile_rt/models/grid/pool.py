"""Execution of a grid: first its sweeps are written, then its tasks run in processes.

All cells share one sweep set, a subset of the grid's `data`. Finished tasks are not repeated after
an interruption.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

from tactile_rt.core.errors import TactileError
from tactile_rt.core.locks import alone_in
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.grid.outcomes import SUBSET, TESTED, Outcome, waiting_tasks, write_tested
from tactile_rt.models.grid.plan import Grid, SweepCounts, Task
from tactile_rt.models.grid.work import Workbench
from tactile_rt.sets.manifest import NEW_SWEEPS, SET_VERSION, SPLITS, SweepManifest, has_object
from tactile_rt.sets.objects import (
    holds_out_sweeps,
    read_object,
    read_skipped,
    write_object,
    write_skipped,
)

Report = Callable[[Outcome, int, int], None]
_bench: Workbench | None = None  # the workbench of this process, in a process of the pool


def run_grid(
    grid: Grid,
    folder: Path,
    processes: int = 1,
    report: Report = lambda found, done, total: None,
    accelerator: str = "cpu",
) -> None:
    """Run all unfinished tasks of a grid.

    Args:
        processes: number of processes to run tasks in; 1: this process.
        report: called with each outcome, and the numbers of finished and of all tasks.

    Raises:
        ConfigError: the folder holds outcomes of another grid, or another process works in it.
    """
    with alone_in(folder):
        _run_locked(grid, folder, processes, report, accelerator)


def _run_locked(grid: Grid, folder: Path, processes: int, report: Report, accelerator: str) -> None:
    tasks = grid.tasks()
    folder.mkdir(parents=True, exist_ok=True)
    waiting = waiting_tasks(grid, folder)
    if not waiting and (folder / TESTED).exists():
        return
    prepare(grid, folder)
    finished = {task.slug for task in tasks} - {task.slug for task in waiting}

    def ready() -> Task | None:
        """Remove and return the next waiting task whose dependencies are finished."""
        for task in waiting:
            if finished.issuperset(grid.list_dependencies(task)):
                waiting.remove(task)
                return task
        return None

    def conclude(found: Outcome, task: Task) -> None:
        finished.add(task.slug)
        report(found, len(finished), len(tasks))

    if processes == 1:
        bench = Workbench(grid, folder, accelerator)
        while task := ready():
            conclude(bench.do(task), task)
        return
    # Spawned: torch does not survive a fork in every state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _begin_process) as pool:
        running: dict[Future[Outcome], Task] = {}
        try:
            while True:
                while len(running) < processes and (task := ready()):
                    running[_submit(pool, grid, folder, accelerator, task)] = task
                if not running:
                    return
                for one in wait(running, return_when=FIRST_COMPLETED).done:
                    conclude(one.result(), running.pop(one))
        except BrokenProcessPool:  # e.g. killed for memory; its task is repeated next time
            raise TactileError(
                "a process of the grid ended: run the grid again to go on, with fewer processes if "
                "memory ran out"
            ) from None
        finally:
            for worker in context.active_children():
                worker.terminate()


def prepare(grid: Grid, folder: Path) -> None:
    """Write the sweeps and the test objects of a grid; existing sweeps are kept."""
    write_subset(Path(grid.data), folder / SUBSET, grid.sweeps)
    test = SweepSet.read(folder / SUBSET, "test")
    known = test.sweeps.objects[:0]
    if holds_out_sweeps(test.manifest):
        known = SweepSet.read(folder / SUBSET, NEW_SWEEPS).sweeps.objects
    write_tested(folder, test.sweeps.objects, len(test.manifest.categories), known)


def write_subset(source: Path, folder: Path, sweeps: SweepCounts) -> None:
    """Copy the first sweeps of each object into a new set; keep existing files."""
    manifest = SweepManifest.read(source)
    taken = {split: getattr(sweeps, split) for split in SPLITS}
    recipe = {key: value for key, value in manifest.recipe.items() if key != "contacts"}
    smaller = replace(
        manifest,
        split={split: manifest.split[split] for split in SPLITS},
        recipe={**recipe, "taken": taken, "from": str(source)},
        version=SET_VERSION,
    )
    smaller.write(folder)
    skipped = read_skipped(source)
    if skipped:
        write_skipped(folder, {k: v for k, v in skipped.items() if k in smaller.names()})
    for split, count in taken.items():
        for name in smaller.split[split]:
            if name in skipped or has_object(folder, name):
                continue
            values, parameters = read_object(source, name)
            few = slice(count or None)
            write_object(folder, name, values[few], {k: v[few] for k, v in parameters.items()})


def _submit(
    pool: ProcessPoolExecutor, grid: Grid, folder: Path, accelerator: str, task: Task
) -> Future[Outcome]:
    """Submit a task to the pool with Ctrl-C blocked, so that new processes ignore it."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(_do_task, grid, folder, accelerator, task)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _begin_process() -> None:
    """Initialise a pool process: one torch thread, and exit when the parent exits."""
    import torch

    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _do_task(grid: Grid, folder: Path, accelerator: str, task: Task) -> Outcome:
    global _bench
    if _bench is None:
        _bench = Workbench(grid, folder, accelerator)
    return _bench.do(task)
