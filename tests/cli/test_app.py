"""The bar of a long command: what it says of the time left."""

import io

import pytest
from rich.console import Console

from tactile_rt.cli.app import progress_bar


@pytest.fixture
def bar():
    """Open a bar on a clock of ours: (update, wait, the task)."""

    def begin(stack, **options):
        console = Console(file=io.StringIO(), force_terminal=True, width=80)
        update = stack.enter_context(progress_bar(console, "objects", **options))
        progress = update.func.__self__
        clock = [0.0]
        progress.get_time = lambda: clock[0]

        def wait(seconds):
            clock[0] += seconds

        return update, wait, progress.tasks[0]

    return begin


@pytest.fixture
def stack():
    from contextlib import ExitStack

    with ExitStack() as opened:
        yield opened


def test_steps_of_minutes_have_a_time_left(bar, stack):
    update, wait, task = bar(stack, total=10)
    for _ in range(4):
        wait(300)
        update(advance=1)
    assert task.time_remaining == pytest.approx(6 * 300)


def test_what_was_there_before_does_not_hasten_it(bar, stack):
    update, wait, task = bar(stack, total=1000, completed=990, counted=True)
    for _ in range(3):
        wait(10)
        update(advance=1, description="mug-1")
    assert task.time_remaining == pytest.approx(7 * 10)
    assert (task.completed, task.description) == (993, "mug-1")


def test_a_log_file_keeps_clean():
    console = Console(file=io.StringIO())
    with progress_bar(console, "objects", total=2) as update:
        update(advance=1)
    assert console.file.getvalue() == ""
