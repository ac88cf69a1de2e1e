"""Discovery and diagnosis, on made-up /sys and /dev trees."""

import json
import os
from types import SimpleNamespace

import pytest

from tactile_rt.drivers import discovery
from tactile_rt.drivers.discovery import CanBus, diagnose, list_can_buses


@pytest.fixture
def net(tmp_path):
    """An Ethernet and two CAN interfaces, as the kernel shows them."""
    for name, kind, flags in (("eth0", 1, "0x1003"), ("can0", 280, "0x1"), ("can1", 280, "0x0")):
        (tmp_path / name / "can_bittiming").mkdir(parents=True)
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "flags").write_text(f"{flags}\n")
    (tmp_path / "can0" / "can_bittiming" / "bitrate").write_text("500000\n")
    return tmp_path


def test_can_interfaces_are_found_by_their_type(net):
    up, down = list_can_buses(net)
    assert (up.name, up.up, up.bitrate) == ("can0", True, 500_000)
    assert (down.name, down.up) == ("can1", False)
    assert up.url == "can:socketcan:can0?codec="
    assert list_can_buses(net / "nothing") == []


def test_ports_are_known_by_their_numbers(monkeypatch, tmp_path):
    def port(device, vid, pid, serial_number=None, hwid="USB"):
        return SimpleNamespace(device=device, vid=vid, pid=pid, serial_number=serial_number,
                               hwid=hwid, description="n/a")  # fmt: skip

    found = [
        port("/dev/ttyUSB0", 0x0403, 0x6014, "FT3X"),
        port("/dev/ttyACM0", 0x16D0, 0x117E),
        port("/dev/ttyACM1", 0x239A, 0x8022),
        port("/dev/ttyACM2", 0x1234, 0x5678),
        port("/dev/ttyS4", None, None, hwid="n/a"),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    ports = discovery.serial_ports(tmp_path)
    assert [p.path for p in ports] == [f"/dev/tty{x}" for x in ("ACM0", "ACM1", "ACM2", "USB0")]
    adapter, skin, _, ftdi = ports
    assert adapter.url == "can:slcan:/dev/ttyACM0?codec="
    assert skin.url == "serial:///dev/ttyACM1?codec=anyskin" and "AnySkin" in skin.likely
    assert ftdi.url == "serial:///dev/ttyUSB0?codec=" and ftdi.serial_number == "FT3X"


def port_at(path, usb=(0x0403, 0x6014), serial_number="FT3X"):
    return discovery.Port(str(path), "", usb, serial_number, "", "")


@pytest.fixture
def port(tmp_path):
    """An adapter that is plugged in."""
    (tmp_path / "ttyUSB0").touch()
    return port_at(tmp_path / "ttyUSB0")


def test_a_port_that_may_not_be_opened_is_explained(port, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    (finding,) = diagnose([port], [], tmp_path, lambda _: "")
    assert not finding.good and "no permission" in finding.says
    assert finding.do.startswith("sudo usermod -aG ")


@pytest.mark.parametrize(("ms", "good"), [(1, True), (16, False)])
def test_a_slow_adapter_is_named(port, tmp_path, ms, good):
    timer = tmp_path / "bus/usb-serial/devices/ttyUSB0/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text(f"{ms}\n")
    finding = diagnose([port], [], tmp_path, lambda _: "")[-1]
    assert finding.good is good and f"{ms} ms" in finding.says
    assert good or str(timer) in finding.do


@pytest.mark.parametrize(
    ("state", "tx", "good", "do"),
    [
        ("ERROR-ACTIVE", 0, True, ""),
        ("ERROR-PASSIVE", 128, False, "terminated"),
        ("BUS-OFF", 248, False, "restart-ms"),
    ],
)
def test_a_bus_says_how_it_is(tmp_path, state, tx, good, do):
    info = {"state": state, "bittiming": {"bitrate": 10**6}, "berr_counter": {"tx": tx, "rx": 0}}
    said = json.dumps([{"linkinfo": {"info_data": info}}])
    (finding,) = diagnose([], [CanBus("can0", True, 0, "")], tmp_path, lambda _: said)
    assert finding.good is good and state in finding.says and do in finding.do


def test_a_bus_that_is_down_and_no_device_at_all(tmp_path):
    (down,) = diagnose([], [CanBus("can0", False, 250_000, "")], tmp_path, lambda _: "")
    assert not down.good and "up type can bitrate 250000" in down.do
    (nothing,) = diagnose([], [], tmp_path, lambda _: "")
    assert not nothing.good and "emulate" in nothing.do


def test_a_modem_manager_is_noticed(port, tmp_path):
    findings = diagnose([port], [], tmp_path, lambda _: "active\n")
    assert findings[-1].what == "ModemManager" and not findings[-1].good
    findings = diagnose([port], [], tmp_path, lambda _: "inactive\n")
    assert all(f.good for f in findings)


def test_rules_name_each_device():
    rules = discovery.udev_rules([port_at("/dev/ttyUSB0"), port_at("/dev/ttyS0", None)])
    assert 'ATTR{latency_timer}="1"' in rules
    (line,) = [x for x in rules.splitlines() if "SYMLINK" in x]
    assert 'ATTRS{idVendor}=="0403"' in line and 'SYMLINK+="tactile-FT3X"' in line
    assert "ID_MM_DEVICE_IGNORE" in line
