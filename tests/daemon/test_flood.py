"""Thousands of connections to every port, while the recorder goes on from file to file."""

import os
import re
import resource
import signal
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from bench.daemon.process import free_port
from tactile_rt.daemon.publishers.sending import ConnectionLimit
from tactile_rt.recording import Recording
from tests.helpers.processes import start_program
from tests.helpers.waiting import PATIENCE_S, until

for module in ("mcap", "zmq", "zenoh", "foxglove"):
    pytest.importorskip(module)

CONFIG = """version = 1
[[source]]
name = "a"
url = "synthetic:2x2?rate_hz=1000"
[recorder]
folder = "rec"
rotate_s = 1
[[publisher]]
kind = "zmq"
options = {{ bind = "tcp://127.0.0.1:{0}", samples = true, connections = 4 }}
[[publisher]]
kind = "zenoh"
options = {{ listen = ["tcp/127.0.0.1:{1}"], connections = 4 }}
[[publisher]]
kind = "foxglove"
options = {{ port = {2}, connections = 4 }}
[page]
port = {3}
[metrics]
port = {4}
"""
FLOOD = 2000


def can_connect(port):
    try:
        socket.create_connection(("127.0.0.1", port), PATIENCE_S).close()
    except OSError:
        return False
    return True


def flood(ports):
    lines = []
    for port in ports:
        for _ in range(FLOOD):
            line = socket.socket()
            line.setblocking(False)
            line.connect_ex(("127.0.0.1", port))
            lines.append(line)
    return lines


@pytest.fixture
def many_descriptors():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 6 * FLOOD:
        pytest.skip(f"this process may open {hard} descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_flood_of_connections_costs_no_sample_and_leaves_nothing(
    tmp_path, monkeypatch, many_descriptors
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    ports = [free_port() for _ in range(5)]
    (tmp_path / "robot.toml").write_text(CONFIG.format(*ports))
    with (tmp_path / "log").open("w") as log:
        options = {"cwd": tmp_path, "stdout": None, "stderr": log}
        daemon = start_program("run", tmp_path / "robot.toml", **options)
    try:
        status = Path(f"/proc/{daemon.pid}/status")

        def memory_mb():
            return int(re.search(r"VmRSS:\s+(\d+)", status.read_text())[1]) / 1024

        def descriptors():
            return len(os.listdir(f"/proc/{daemon.pid}/fd"))

        def files():
            return sorted((tmp_path / "rec").rglob("*.mcap"), key=lambda p: p.stat().st_mtime)

        until(lambda: all(map(can_connect, ports)) and len(files()) > 2)
        before, memory = descriptors(), memory_mb()
        lines = flood(ports)
        recorded = len(files())
        until(lambda: len(files()) > recorded + 2 and descriptors() < before + 2 * 80)
        for line in lines:
            line.close()
        until(lambda: descriptors() < before + 10)
        until(lambda: memory_mb() < 1.2 * memory)
        assert all(map(can_connect, ports))
    finally:
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(PATIENCE_S) == 0, (tmp_path / "log").read_text()
    seq = [n for path in files() for chunk in Recording(path) for n in chunk.seq.tolist()]
    assert seq == list(range(seq[0], seq[0] + len(seq)))


@pytest.mark.parametrize("unix", [False, True])
def test_the_first_connections_stay_and_the_rest_are_shut_down(tmp_path, unix):
    with ExitStack() as stack:
        path, family = str(tmp_path / "s"), socket.AF_UNIX if unix else socket.AF_INET
        listening = stack.enter_context(socket.socket(family))
        listening.bind(path if unix else ("127.0.0.1", 0))
        listening.listen()
        address = listening.getsockname()
        accepted = []

        def connect():
            line = stack.enter_context(socket.socket(listening.family))
            line.settimeout(PATIENCE_S)
            line.connect(address)
            accepted.append(stack.enter_context(listening.accept()[0]))
            return line

        limit = ConnectionLimit("test limit", {path if unix else address[1]}, 2)
        others = [stack.enter_context(end) for end in socket.socketpair()]
        first = [connect() for _ in range(2)]
        until(lambda: limit.connections == 2)
        rest = [connect() for _ in range(3)]
        assert [line.recv(1) for line in rest] == [b""] * 3
        until(lambda: limit.dropped == 3)
        assert limit.full
        for line, end in zip(first, accepted, strict=False):
            end.sendall(b"x")
            assert line.recv(1) == b"x"
        others[0].sendall(b"z")
        assert others[1].recv(1) == b"z"
        accepted[0].close()  # makes room
        until(lambda: limit.connections == 1)
        assert not limit.full
        line = connect()
        accepted[-1].sendall(b"y")
        assert line.recv(1) == b"y"
        limit.close(lambda: (line.recv(1), first[1].recv(1)))  # it ends: they are shut down
