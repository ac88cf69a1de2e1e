"""`tactile-rt top`: what it shows, and where it gets it from."""

import dataclasses
import io
import socket
import sys
import threading

import pytest
from rich.console import Console

from bench.daemon.process import free_port
from tactile_rt.cli.top import picture, read_snapshots, snapshot_at
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.daemon.config import MetricsConfig
from tactile_rt.daemon.messages import encode, message_of, state_message
from tactile_rt.daemon.metrics import Metrics
from tactile_rt.daemon.states import ConsumerState, Diagnostic
from tests.helpers.published import View, busy_snapshot, decision, event, part, running

SHOWN = """\
tactile_rt 1.2.3 degraded  up 0:00:10  pid 77  reloaded 1x  clock stepped 2x  /etc/robot.toml
  no samples: source.finger: the device is lost

SOURCE    STATE       HZ    OF  SAMPLES  MISS  BAD  DROP  DUP  LOST/MIN  AGE MS  ARRAY
whiskers  streaming  998  1000     7000     3    4     2    1         0       4  2 x 3 mouse
finger    lost         -   110        0     0    0     0    0         0          unplugged

MODEL     STATE    DECISIONS  FINAL  P50 MS  P99  MAX  STEP  LATE  SKIP  DROP  NEWEST
whiskers  running         40      4     5.0  9.5  9.5   5.0     0     0     2  mug 93% touching

CONSUMER  STATE         STARTS  WAIT  TAKEN  DROP  P50 MS  P99  MAX  TELLS
zmq       running            1     1      9     2     5.0  9.5  9.5  end\
point tcp://127.0.0.1:5556, messages 40
recorder  waiting (9x)      10     0      0     0                    No space left on device
"""


def text(renderable, width=118):
    console = Console(file=io.StringIO(), width=width)
    console.print(renderable)
    return "".join(f"{x.rstrip()}\n" for x in console.file.getvalue().splitlines())


@pytest.fixture
def daemon():
    """URL of one that is being watched."""
    port = free_port()
    with running(Metrics("metrics", MetricsConfig(port=port)), View(snapshot=busy_snapshot())):
        yield f"http://127.0.0.1:{port}"


@pytest.fixture
def top(call, monkeypatch):
    """Call `top` on a terminal of 118 columns."""
    monkeypatch.setenv("COLUMNS", "118")
    return lambda *arguments: call("top", *arguments)


def test_all_that_matters_is_on_one_screen():
    assert text(picture(busy_snapshot(2))) == SHOWN


def test_the_enrolled_object_stands_beside_the_class():
    snapshot = busy_snapshot()
    model = dataclasses.replace(snapshot.models[0], object="red mug")
    shown = text(picture(dataclasses.replace(snapshot, models=(model,))), 140)
    assert "mug 93%, object: red mug touching" in shown


def test_markup_in_a_reason_is_text():
    snapshot = dataclasses.replace(busy_snapshot(), degraded=("[red]x[/nonsense]",))
    assert "[red]x[/nonsense]" in text(picture(snapshot))


def test_it_looks_at_a_running_daemon(daemon, top):
    assert snapshot_at(daemon) == busy_snapshot()
    code, out, err = top(daemon, "--once")
    assert code == 0, err
    assert "mug 93% touching" in out and "No space left on device" in out
    code, out, err = top(daemon.removeprefix("http://"), "--once")
    assert code == 0, err


def test_doctor_says_what_a_daemon_suffers_from_and_what_its_log_said(call, tmp_path, monkeypatch):
    (tmp_path / "log").write_text("a warning b: old\na warning c: new\na info d: fine\n")
    log = ConsumerState(part("log"), "log", details={"file": str(tmp_path / "log")})
    found = Diagnostic("source.a", "no samples", "lost", says="a gives none.", do="Look at it.")
    sick = dataclasses.replace(busy_snapshot(), diagnostics=(found,), consumers=(log,))
    for shown, ends in ((sick, 1), (dataclasses.replace(sick, diagnostics=()), 0)):
        monkeypatch.setattr("tactile_rt.cli.top.snapshot_at", lambda url, shown=shown: shown)
        code, out, _ = call("doctor", "--daemon", "http://robot:9464")
        assert code == ends and "a warning c: new" in out and "5000 samples, 9 lost" in out
        assert ("bad source.a: a gives none.\n    -> Look at it.\n" in out) == bool(ends)


def test_it_reads_what_the_jsonl_publisher_says(top, monkeypatch):
    lines = [encode(message_of(decision())), b"garbage", encode(message_of(event()))]
    lines += [encode(state_message(busy_snapshot(s))) for s in (0, 2)]
    assert list(read_snapshots(iter(lines))) == [busy_snapshot(), busy_snapshot(2)]
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\n".join(lines) + b"\n")))
    code, out, err = top("-")
    assert code == 0, err
    assert "7000" in out and "streaming  998  1000" in out
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"garbage\n")))
    code, out, err = top("-")
    assert code == 2 and "state_s = 1" in err


def test_whatever_is_there_instead_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        at = f"http://127.0.0.1:{server.getsockname()[1]}"

        def answer(text):
            line, _ = server.accept()
            with line:
                line.recv(4096)
                line.sendall(text)

        for said, error in (
            (b"SSH-2.0-nonsense\r\n", SourceError),
            (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", ConfigError),
            (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", ConfigError),
        ):
            thread = threading.Thread(target=answer, args=(said,))
            thread.start()
            with pytest.raises(error, match=at):
                snapshot_at(at)
            thread.join()
    with pytest.raises(SourceError, match="Connection refused; is that the port of its"):
        snapshot_at(at)
