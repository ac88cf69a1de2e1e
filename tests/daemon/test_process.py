"""`tactile-rt run robot.toml` as a process: signals and exit codes; `tactile-rt config`."""

import contextlib
import itertools
import json
import os
import shlex
import signal
import socket
import termios
import threading
from pathlib import Path
from unittest import mock

import pytest

from bench.daemon.process import free_port, messages_of
from tactile_rt.daemon.config import ADMISSION, EXAMPLE
from tests.helpers.processes import run_program, start_program
from tests.helpers.waiting import PATIENCE_S, until

# Sends itself a signal when it imports for the nth time since it is the daemon; 0: at each time.
SIGNALLED = """
import os, signal, sys
at, number, seen = int(sys.argv.pop(1)), int(sys.argv.pop(1)), 0
def hook(event, arguments):
    global seen
    if event == "import" and signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        seen += 1
        if at in (0, seen):
            os.kill(os.getpid(), number)
sys.addaudithook(hook)
from tactile_rt.cli import main
try:
    main()
finally:
    print(seen)
"""
SMALL = """version = 1
[[source]]
name = "a"
url = "synthetic:2x2"
[[publisher]]
kind = "jsonl"
options = { file = "out.jsonl" }
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.toml").write_text(SMALL)
    return tmp_path


@pytest.fixture
def started(folder):
    """Start a daemon, and come back when it runs."""
    processes = []

    def start(*arguments, until=("source.a", "running")):
        process = start_program("run", folder / "robot.toml", *arguments)
        processes.append(process)
        await_told(folder, *until)
        return process

    yield start
    for process in processes:
        process.kill()
        with process:
            pass


def told(folder):
    return messages_of(folder / "out.jsonl", "health")


def await_told(folder, part, state):
    until(lambda: any((m["part"], m["state"]) == (part, state) for m in told(folder)))


def ended(process):
    """(exit code, log)"""
    _, log = process.communicate(timeout=PATIENCE_S)
    return process.returncode, log


def test_signals_reload_and_stop_and_a_second_one_is_refused(folder, started, call):
    first = started()
    code, out, err = call("run", folder / "robot.toml")
    assert code == 3 and out == ""
    assert f"robot.toml is in use by process {first.pid}\n" in err
    (folder / "robot.toml").write_text(SMALL.replace("2x2", "2by2"))
    first.send_signal(signal.SIGHUP)
    await_told(folder, "daemon", "refused")
    (folder / "robot.toml").write_text(SMALL + '[[source]]\nname = "b"\nurl = "synthetic:1x1"\n')
    first.send_signal(signal.SIGHUP)
    await_told(folder, "source.b", "running")
    first.send_signal(signal.SIGTERM)
    code, log = ended(first)
    assert code == 0, log
    refused = next(m for m in told(folder) if m["state"] == "refused")
    assert refused["level"] == "error"
    assert "robot.toml:4: source[0].url: synthetic:2by2 is not a size" in refused["reason"]
    states = [(m["part"], m["state"]) for m in told(folder)]
    assert states.count(("source.a", "running")) == 1  # it went on undisturbed
    assert ("source.b", "stopped") in states
    assert "Traceback" not in log and "daemon stopping" in log


def test_a_reload_that_hangs_is_told_and_keeps_no_later_one(monkeypatch):
    """As one on a dead mount does."""
    from tactile_rt.daemon import checks, loading, process

    answers, calls, daemon = threading.Event(), process.Calls(), mock.Mock()
    files = iter([lambda: answers.wait(PATIENCE_S) and "old", lambda: "good"])
    monkeypatch.setattr(loading, "load_config", lambda path, sets: next(files)())
    monkeypatch.setattr(checks, "check_config", lambda loaded: None)
    monkeypatch.setattr(process, "READ_S", 0.1)
    serve = threading.Thread(
        target=process._serve, args=(daemon, Path("robot.toml"), (), calls, None)
    )
    serve.start()
    calls.put(signal.SIGHUP)
    until(lambda: daemon.refuse.called)
    assert "robot.toml: 0.1 s do not do to read it" in daemon.refuse.call_args.args[0]
    calls.put(signal.SIGHUP)
    until(lambda: daemon.reload.called)
    answers.set()  # now it answers, and what it read is of before
    until(lambda: not any(t.name == "tactile-rt reload" for t in threading.enumerate()))
    daemon.reload.assert_called_once_with("good")
    daemon.refuse.assert_called_once()
    refused = mock.Mock(side_effect=RuntimeError("no thread"))
    monkeypatch.setattr(process._Reload, "start", refused)
    calls.put(signal.SIGHUP)
    until(lambda: "no thread" in daemon.refuse.call_args.args[0])
    calls.put(signal.SIGTERM)
    serve.join(PATIENCE_S)
    assert not serve.is_alive()


def second(folder, file="robot.toml", *arguments, **environment):
    """(exit code, errors) of a daemon that is started beside the first one."""
    environment = {**os.environ, **environment}
    done = run_program("run", folder / file, "--seconds", "0.1", *arguments, env=environment)
    return done.returncode, done.stderr


def test_a_second_one_is_refused_whatever_its_environment(folder, started):
    """Also under another name, and with another output: the rest of it would be written twice."""
    first = started()
    (folder / "link.toml").symlink_to("robot.toml")
    other = folder / "other"
    other.mkdir()
    places = dict.fromkeys(("XDG_RUNTIME_DIR", "TMPDIR", "HOME"), str(other))
    for file in ("robot.toml", "link.toml"):
        code, said = second(
            folder, file, "--set", f"publisher.jsonl.options.file={folder}/x", **places
        )
        assert (code, said.count("\n")) == (3, 1) and f"in use by process {first.pid}\n" in said
    assert list(other.iterdir()) == []  # and nothing is written to find that out
    first.kill()
    first.wait(PATIENCE_S)
    assert second(folder)[0] == 0  # what was killed keeps nobody away


def signalled(folder, at, number, seconds):
    """A process that is signalled while it starts."""
    words = ("run", folder / "robot.toml", "--seconds", seconds)
    return start_program(at, int(number), *words, program=SIGNALLED)


def test_a_signal_at_any_moment_of_the_start_ends_it_in_order(folder):
    """The moments are those at which something is imported: most of the first second."""
    imports = int(signalled(folder, -1, signal.SIGTERM, 0.1).communicate(timeout=PATIENCE_S)[0])
    assert imports > 200  # else they are noted too late
    for number, moments in ((signal.SIGTERM, 6), (signal.SIGINT, 3)):
        for at in (1 + imports * k // moments for k in range(moments)):
            code, log = ended(signalled(folder, at, number, PATIENCE_S))
            assert code == 0 and "Traceback" not in log, (number, at, code, log)


def test_a_reload_asked_for_at_every_moment_of_the_start_ends_nothing(folder):
    process = signalled(folder, 0, signal.SIGHUP, 1.0)
    code, log = ended(process)
    assert code == 0 and "Traceback" not in log and "source.a running" in log, (code, log)


def test_the_example_decides_what_was_touched(tmp_path):
    run_program("config", "example", "robot.toml", cwd=tmp_path, check=True)
    port = f"page.port={free_port()}"
    words = ("run", "robot.toml", "--set", port)
    with start_program(*words, cwd=tmp_path, stderr=None) as process:
        try:
            published = map(json.loads, process.stdout)
            finals = (m["label"] for m in published if m["type"] == "decision" and m["final"])
            # Of what passed before the model was ready it may have felt a part.
            assert "bottle" in itertools.islice(finals, 4)
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


def test_what_is_made_up_is_said_to_be(folder, monkeypatch, call):
    monkeypatch.chdir(folder)
    (folder / "robot.toml").write_text(EXAMPLE)
    url = "source.whiskers.url=synthetic:mouse"
    _, said, _ = call("config", "check", "robot.toml", "--set", url)
    assert said.endswith("source whiskers is made up: decisions on it mean nothing\n")
    _, said, _ = call("config", "check", "robot.toml")
    assert "made up" not in said
    _, _, err = call("run", "--source", "synthetic:mouse?seconds=0.1")
    assert err.startswith("synthetic:mouse?seconds=0.1 is made up: decisions on it mean")


def test_a_stream_that_is_over_and_a_time_that_is_up_end_it(folder, done):
    url = "source.a.url=synthetic:2x2?seconds=1&pace=fast"
    samples = "publisher.jsonl.options.samples=true"
    done("run", folder / "robot.toml", "--set", url, "--set", samples)
    assert sum(len(m["seq"]) for m in messages_of(folder / "out.jsonl", "samples")) == 1000
    code, err = second(folder)
    assert code == 0 and "source.a stopped" in err


@contextlib.contextmanager
def silent_line(kind):
    """A URL of a device that is asked to begin, and never sends; whether it has been asked."""
    with contextlib.ExitStack() as open_now:
        if kind in ("serial", "can:slcan"):
            master, slave = os.openpty()
            for handle in (master, slave):
                open_now.callback(os.close, handle)
            # Somebody has it open, or the port has settings of its own.
            yield (
                f"{kind}:{os.ttyname(slave)}",
                lambda: termios.tcgetattr(slave)[4] != termios.B38400,
            )
            return
        if kind == "can:virtual":
            yield "can:virtual:tactile-silent", lambda: True
            return
        peer = open_now.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        url = f"serial:socket://127.0.0.1:{peer.getsockname()[1]}"
        if kind == "socket":
            peer.settimeout(PATIENCE_S)
            yield url, lambda: bool(open_now.enter_context(peer.accept()[0]))
            return
        # Nobody takes what knocks: its queue is full, and whoever comes now waits to be let in.
        for _ in range(2):
            knocks = open_now.enter_context(socket.socket())
            knocks.setblocking(False)
            knocks.connect_ex(peer.getsockname())
        yield url, lambda: True


@pytest.mark.parametrize("kind", ["serial", "can:slcan", "can:virtual", "socket", "not let in"])
def test_a_device_that_never_sends_keeps_nothing_from_stopping(folder, started, kind):
    with silent_line(kind) as (url, asked):
        option = f"source.a.url={url}?codec=native&start_s=60"
        process = started("--set", option, until=("daemon", "starting"))
        until(asked)
        process.send_signal(signal.SIGTERM)
        code, log = ended(process)
    assert code == 0, log  # 4: something did not end within 2 s
    assert "source.a stopped" in log and "abandoned" not in log and "Traceback" not in log


def test_what_hangs_at_the_end_is_left_behind(folder, started):
    """Nobody reads its output: the pipe is full, and writing to it never returns."""
    (folder / "robot.toml").write_text(
        SMALL + '[[publisher]]\nkind = "jsonl"\nname = "piped"\noptions = { samples = true }\n'
    )
    process = started("--set", "source.a.url=synthetic:35x6", "--set", "limits.stall_s=0.5")
    await_told(folder, "publisher.piped", "stalled")
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 4
    log = process.stderr.read()
    assert "error publisher.piped abandoned: it did not end in time" in log
    assert "source.a stopped" in log


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run"], "run needs a configuration (robot.toml, --set with it) or --source URL"),
        (["run", "--source", "synthetic:", "--set", "a=1"], "run needs a configuration"),
        (
            ["run", "robot.toml", "--source", "synthetic:"],
            "robot.toml says source, model and decisions",
        ),
        (["run", "gone.toml"], "gone.toml: no such file"),
        (["run", "robot.toml", "--set", "page.port=0"], "page.port: expected a whole number >= 1"),
        (["config", "check", "robot.toml", "--set", "sorce=1"], "did you mean source?"),
        (["config", "example", "robot.toml"], "robot.toml already exists"),
        (["config", "example", "gone/robot.toml"], "no folder gone to write"),
    ],
)
def test_a_users_mistake_is_one_line(folder, monkeypatch, refused, arguments, message):
    monkeypatch.chdir(folder)
    assert message in refused(*arguments)


def test_config_commands(folder, monkeypatch, call):
    monkeypatch.chdir(folder)
    assert call("config", "check", "robot.toml") == (
        0, "robot.toml: 1 source, 0 models, 1 publisher: all right\n", "",
    )  # fmt: skip
    _, shown, _ = call("config", "show", "robot.toml", "--set", "log.level=error")
    assert 'level = "error"' in shown and f"{folder}/out.jsonl" in shown
    assert call("config", "example")[1] == EXAMPLE
    assert call("config", "example", "new.toml")[0] == 0
    assert call("config", "check", "new.toml")[0] == 0
    _, said, _ = call("config", "example", "rö bot.toml")
    assert said.endswith("run it with: tactile-rt run 'rö bot.toml'\n")
    assert shlex.split(said.partition("with: ")[2]) == ["tactile-rt", "run", "rö bot.toml"]


def test_the_daemon_reaches_nothing_that_a_robot_does_not_have():
    code = (
        "import sys, tactile_rt.daemon.daemon, tactile_rt.daemon.checks, "
        "tactile_rt.daemon.publishers.jsonl, tactile_rt.recording.importing.bag\n"
        "print({'torch', 'mujoco', 'trimesh', 'scipy', 'matplotlib', 'rosbags'} & {*sys.modules})"
    )
    assert run_program(program=code, check=True).stdout == "set()\n"


@pytest.mark.parametrize("ends", [True, False])
def test_a_model_that_is_being_loaded_does_not_abort_the_end(monkeypatch, ends):
    """A thread in native code is torn out of it when the interpreter ends, and C++ aborts."""
    from tactile_rt.daemon import process

    loaded, left = threading.Event(), []
    thread = threading.Thread(target=loaded.wait, name=ADMISSION, daemon=True)
    thread.start()
    monkeypatch.setattr(process, "LOADED_S", PATIENCE_S if ends else 0.0)
    monkeypatch.setattr(process.os, "_exit", left.append)
    if ends:
        loaded.set()
    with pytest.raises(SystemExit):
        process.leave(process.ExitCode.STOPPED)
    assert left == ([] if ends else [process.ExitCode.STOPPED])
    loaded.set()
    thread.join()
