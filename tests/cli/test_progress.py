"""What a long command says of the time left: a bar on a terminal, lines in a log file."""

import io

import pytest
from rich.console import Console

from tactile_rt.cli import tables
from tactile_rt.cli.tables import describe_task, progress_bar
from tests.helpers.waiting import until


@pytest.fixture(params=[True, False], ids=["terminal", "log"])
def bar(request):
    """Open a bar on a clock of ours: (context, and of it: update, wait, the task)."""

    def begin(**options):
        console = Console(file=io.StringIO(), force_terminal=request.param, width=80)
        shown = progress_bar("objects", console=console, **options)
        update = shown.__enter__()
        clock = [0.0]
        progress = update.func.__self__
        (task,) = progress.tasks
        progress.get_time = task._get_time = lambda: clock[0]
        task.start_time = 0.0

        def wait(seconds):
            clock[0] += seconds

        request.addfinalizer(lambda: shown.__exit__(None, None, None))
        return update, wait, task

    return begin


def test_steps_of_minutes_have_a_time_left(bar):
    update, wait, task = bar(total=10)
    for _ in range(4):
        wait(300)
        update(advance=1)
    assert task.time_remaining == pytest.approx(6 * 300)


def test_what_was_there_before_does_not_hasten_it(bar):
    update, wait, task = bar(total=1000, completed=990, counted=True)
    for _ in range(3):
        wait(10)
        update(advance=1, description="mug-1")
    assert task.time_remaining == pytest.approx(7 * 10)
    assert describe_task(task, True) == "mug-1: 993 of 1000, 30 s so far, about 70 s left"


def test_shares_are_per_cent_and_long_times_are_minutes_and_hours(bar):
    update, wait, task = bar(total=1.0)
    for share in (0.0125, 0.025):
        wait(150)
        update(completed=share)
    assert describe_task(task, False) == "objects: 2 %, 5 min so far, about 3.2 h left"
    assert describe_task(task, False, timed=False) == "objects: 2 %, 5 min so far"


def test_a_log_file_gets_a_line_whenever_one_is_due(monkeypatch):
    monkeypatch.setattr(tables, "LINE_S", 0.01)
    console = Console(file=io.StringIO())
    with progress_bar("[x] reading", console=console) as update:
        until(lambda: console.file.getvalue().startswith("[x] reading: 0 s so far\n"))
        update(description="fitting")
        until(lambda: "\nfitting: " in console.file.getvalue())


def test_what_is_done_or_fails_before_a_line_is_due_says_nothing():
    console = Console(file=io.StringIO())
    with progress_bar("objects", total=2, console=console) as update:
        update(advance=1)
    with pytest.raises(ZeroDivisionError), progress_bar("objects", console=console):
        raise ZeroDivisionError
    assert console.file.getvalue() == ""
