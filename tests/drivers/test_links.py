"""Serial ports that are somewhere else: pyserial's socket:// and rfc2217://, with a real device."""

import contextlib
import os
import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import serial
import serial.rfc2217

from tactile_rt.core.stream import concatenate
from tactile_rt.drivers.health import State
from tactile_rt.drivers.links import SerialLink
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeSerial
from tests.helpers.waiting import PATIENCE_S, read_chunks, until

SAMPLES = 600


class Pty(serial.Serial):
    """A pty has no control lines, which a server of RFC 2217 sets and watches."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self):
        pass

    _update_rts_state = _update_dtr_state


def raw(port, connection):
    """Bytes as they are."""
    return SimpleNamespace(escape=lambda data: [data], filter=lambda data: [data])


def rfc2217(port, connection):
    """pyserial's own server of RFC 2217."""
    return serial.rfc2217.PortManager(port, SimpleNamespace(write=connection.sendall))


@contextlib.contextmanager
def served(path, protocol):
    """A server of one serial port for one client; gives (its TCP port, a way to hang up)."""
    listener = socket.create_server(("127.0.0.1", 0))
    over, connections = threading.Event(), []

    def serve():
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        connections.append(connection)
        with Pty(path, timeout=0.02) as port:
            speaks = protocol(port, connection)
            connection.settimeout(0.02)
            while not over.is_set():
                try:
                    with contextlib.suppress(TimeoutError):
                        for data in speaks.filter(connection.recv(4096)):
                            port.write(data)
                    for data in speaks.escape(port.read(max(1, port.in_waiting))):
                        connection.sendall(data)
                except OSError:
                    return

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()

    def hang_up():
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    try:
        yield listener.getsockname()[1], hang_up
    finally:
        over.set()
        hang_up()
        listener.close()
        thread.join(5)
        for connection in connections:
            connection.close()


def test_a_backlog_is_one_packet_where_nobody_looked(monkeypatch):
    """A terminal gives it in parts, which came at one moment all the same."""
    far, near = os.openpty()
    with contextlib.closing(SerialLink(os.ttyname(near), 115_200)) as link:
        os.write(far, bytes(10_000))
        assert len(link.receive(PATIENCE_S)[0]) < 5000
        monkeypatch.setattr("tactile_rt.drivers.links.STALLED_S", -1.0)
        data, _ = link.receive(PATIENCE_S)
    os.close(far), os.close(near)
    assert len(data) > 5000


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial 3.5's own
@pytest.mark.parametrize(("scheme", "protocol"), [("socket", raw), ("rfc2217", rfc2217)])
def test_a_port_on_another_host_is_read_bit_for_bit_and_known_to_be_gone(scheme, protocol):
    values = np.random.default_rng(1).normal(size=(SAMPLES, 4, 6)).astype(np.float32) * 1e-3
    with FakeSerial(values) as fake, served(fake.port, protocol) as (port, hang_up):
        url = f"serial:{scheme}://127.0.0.1:{port}?codec=native&start_s={PATIENCE_S:g}"
        with open_source(url) as source:
            assert np.array_equal(concatenate(read_chunks(source, SAMPLES)).values, values)
            hang_up()
            until(lambda: source.health.state == State.LOST, meanwhile=lambda: source.read(0.05))
