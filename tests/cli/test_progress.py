"""What a long command says of the time left: a bar on a terminal, lines in a log file."""

import io
import queue

import pytest
from rich.console import Console

from tactile_rt.cli.progress import progress_bar, working


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


class LogFile:
    """A console of no terminal, on a clock of ours: lines come when `tick` says that time is up."""

    def __init__(self):
        self.console = Console(file=io.StringIO())
        self.now = 0.0
        self._ticks, self._waits = queue.Queue(), queue.Queue()

    def wait(self, done):
        self._waits.put(None)
        return self._ticks.get()

    def clock(self):
        return self.now

    def tick(self, seconds, over=False):
        """Let time pass while it waits; the lines that there are once it waits again."""
        self.now += seconds
        self._waits.get()
        self._ticks.put(over)
        if not over:
            self._waits.get()  # it has told
            self._waits.put(None)
        return self.console.file.getvalue().splitlines()


@pytest.fixture
def log():
    return LogFile()


def test_a_log_file_gets_a_line_whenever_one_is_due(log):
    with progress_bar(
        log.console, "objects", 40, completed=10, counted=True, wait=log.wait, clock=log.clock
    ) as update:
        assert log.tick(10) == ["objects: 10 of 40, 10 s so far"]
        update(advance=1, description="mug-1")
        update(advance=9)
        assert log.tick(10)[1:] == ["objects: 20 of 40, mug-1, 20 s so far, about 40 s left"]
        update(completed=25, total=1000)
        assert log.tick(280)[2:] == ["objects: 25 of 1000, mug-1, 5 min so far, about 5.4 h left"]
        log.tick(0, over=True)
    assert len(log.console.file.getvalue().splitlines()) == 3


def test_shares_are_per_cent_and_names_are_told_as_they_are(log):
    with progress_bar(log.console, "[x] reading", 1.0, wait=log.wait, clock=log.clock) as update:
        update(completed=0.25)
        assert log.tick(30) == ["[x] reading: 25 %, 30 s so far, about 90 s left"]
        log.tick(0, over=True)


def test_work_of_unknown_length_says_for_how_long_it_goes_on(log):
    with working(log.console, "evaluating", wait=log.wait, clock=log.clock) as update:
        assert log.tick(10) == ["evaluating: 10 s so far"]
        update(description="fitting")
        assert log.tick(110)[1:] == ["fitting: 2 min so far"]
        log.tick(0, over=True)


def test_what_is_done_before_a_line_is_due_says_nothing():
    console = Console(file=io.StringIO())
    with progress_bar(console, "objects", total=2) as update:
        update(advance=1)
    with working(console, "objects"):
        pass
    assert console.file.getvalue() == ""


def test_an_error_ends_the_lines_and_passes(log):
    with (
        pytest.raises(ZeroDivisionError),
        working(log.console, "evaluating", wait=log.wait, clock=log.clock),
    ):
        log.tick(0, over=True)
        raise ZeroDivisionError
    assert log.console.file.getvalue() == ""
