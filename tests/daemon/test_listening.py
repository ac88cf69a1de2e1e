"""With everything on, as it comes: who can reach the process? The kernel's own tables tell."""

import ipaddress
import os
import re
import struct
from pathlib import Path

import pytest

from bench.daemon.process import free_port
from tactile_rt.daemon.publishers.zenoh import ZenohOptions
from tactile_rt.daemon.publishers.zmq import ZmqOptions
from tests.helpers.daemons import load_checked, running_daemon
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("no_thread_left")
LISTENS = {"tcp": "0A", "tcp6": "0A", "udp": "07", "udp6": "07"}  # state of a waiting socket


def own_sockets():
    """{(protocol, address, port)} at which this process waits for others."""
    mine = set()
    for handle in Path("/proc/self/fd").iterdir():
        try:
            found = re.fullmatch(r"socket:\[(\d+)\]", os.readlink(handle))
        except OSError:
            continue  # of the listing itself
        if found:
            mine.add(found[1])
    waiting = set()
    for protocol, state in LISTENS.items():
        table = Path("/proc/net") / protocol
        for line in table.read_text().splitlines()[1:] if table.exists() else []:
            fields = line.split()
            if fields[3] == state and fields[9] in mine:
                raw, _, port = fields[1].partition(":")
                words = struct.unpack(f">{len(raw) // 8}I", bytes.fromhex(raw))
                address = ipaddress.ip_address(struct.pack(f"={len(words)}I", *words))
                waiting.add((protocol, address, int(port, 16)))
    return waiting


def test_with_everything_on_nothing_listens_beyond_loopback(tmp_path):
    ports = [free_port() for _ in range(5)]
    page, metrics, foxglove, zmq, zen = ports
    # Addresses are those that come by default; ports are others, as somebody may have those.
    bind = re.sub(r"\d+\Z", str(zmq), ZmqOptions().bind)
    (listen,) = (re.sub(r"\d+\Z", str(zen), e) for e in ZenohOptions().listen)
    before = own_sockets()
    loaded = load_checked(
        tmp_path,
        f"""version = 1
[[source]]
name = "a"
url = "synthetic:2x2"
[[publisher]]
kind = "jsonl"
options = {{ file = "out" }}
[[publisher]]
kind = "zmq"
options = {{ bind = "{bind}" }}
[[publisher]]
kind = "zenoh"
options = {{ listen = ["{listen}"] }}
[[publisher]]
kind = "foxglove"
options = {{ port = {foxglove} }}
[page]
port = {page}
control = true
[metrics]
port = {metrics}
[recorder]
folder = "rec"
min_free_mb = 1
[limits]
stop_s = 60
[log]
file = "log"
""",
    )
    with running_daemon(loaded) as daemon:
        until(lambda: daemon.snapshot().state == "running")
        found = own_sockets() - before
    assert {port for _, _, port in found} == set(ports)
    assert all(address.is_loopback for _, address, _ in found), found
    assert "exposed" not in (tmp_path / "log").read_text()
