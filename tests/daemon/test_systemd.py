"""What systemd is told, at a notify socket of the test; the unit file; the install script."""

import shutil
import socket
import subprocess
import sys
import time

import pytest
from published import View, busy_snapshot, event, part, running, until

from tactile_rt.cli import main
from tactile_rt.daemon.config_check import check_config
from tactile_rt.daemon.config_file import load_config
from tactile_rt.daemon.daemon import Daemon
from tactile_rt.daemon.snapshot import ModelState, Snapshot, SourceState
from tactile_rt.daemon.systemd import Systemd, alive, status_of
from tactile_rt.daemon.unit import install_script, unit_text, written_folders
from tactile_rt.stream import ConfigError

SMALL = 'version = 1\n[[source]]\nname = "a"\nurl = "synthetic:2x2"\n'
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    """(what $NOTIFY_SOCKET says, what has come: lines)"""
    name = str(tmp_path / "notify") if request.param == "path" else f"\0tactile-test-{tmp_path}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(name)
        bound.settimeout(0.2)

        def told():
            lines = []
            try:
                while True:
                    lines += bound.recv(4096).decode().split("\n")
            except TimeoutError:
                return lines

        yield name.replace("\0", "@"), told


def notifier(address, **environment):
    return Systemd("systemd", None, {"NOTIFY_SOCKET": address, **environment})


def test_it_tells_ready_reloading_and_stopping_once_each(manager):
    address, told = manager
    view = View(snapshot=Snapshot("0", 1, "x", 5, 5, 1, 0, "starting"))
    with running(notifier(address), view) as view:
        consumer = notifier(address)
        consumer.open(view)
        consumer.handle([event(state="starting")])
        assert told() == ["STATUS=starting: 0 sources, 0 models, 0 publishers"]
        view.shown = Snapshot("0", 1, "x", 5, 5, 1, 0, "running")
        consumer.handle([event()])
        assert told() == ["READY=1", "STATUS=running: 0 sources, 0 models, 0 publishers"]
        consumer.handle([event(part="source.a", state="stopping")])  # no concern of systemd
        assert told() == []
        before = time.monotonic_ns() // 1000
        consumer.handle([event(state="reloading"), event(state="refused", level="error")])
        first, stamp, ready = told()
        assert (first, ready) == ("RELOADING=1", "READY=1")
        name, _, number = stamp.partition("=")
        assert name == "MONOTONIC_USEC" and before <= int(number) <= time.monotonic_ns() // 1000
        consumer.handle([event(state="reloading"), event(state="reloaded")])
        assert [x.partition("=")[0] for x in told()] == ["RELOADING", "MONOTONIC_USEC", "READY"]
        consumer.handle([event(state="stopping")])
        assert told() == ["STOPPING=1"]
        consumer.close()


def test_a_daemon_that_starts_degraded_is_ready_and_says_what_it_lacks(manager):
    address, told = manager
    with running(notifier(address), View(snapshot=busy_snapshot())) as view:
        consumer = notifier(address)
        consumer.open(view)
        consumer.handle([])
        lines = told()
        consumer.close()
    assert lines[0] == "READY=1"
    assert lines[1] == "STATUS=degraded: no samples: source.finger: the device is lost"


def stalled(*names):
    """A daemon of two sources and one model, of which some hang."""
    made = {n: part(n, "stalled" if n in names else "waiting") for n in ("s.a", "s.b", "m.c")}
    return Snapshot(
        "0", 1, "x", 5, 5, 1, 0, "degraded", (), 0,
        (SourceState(made["s.a"], "u"), SourceState(made["s.b"], "u")),
        (ModelState(made["m.c"], "a", "f"),),
    )  # fmt: skip


def test_the_watchdog_is_fed_while_something_works(manager):
    address, told = manager
    view = View(snapshot=stalled("s.a"))
    consumer = notifier(address, WATCHDOG_USEC="2000000")
    assert consumer.tick_s == 0.5
    with running(consumer, view):
        consumer.handle([])
        assert told().count("WATCHDOG=1") == 1
        view.shown = stalled("s.a", "s.b")
        consumer.handle([])
        assert "WATCHDOG=1" not in told()
        assert consumer.details()["pings"] == consumer.details()["withheld"] == 1
    assert not alive(stalled("m.c"))
    assert alive(stalled()) and alive(Snapshot("0", 1, "x", 5, 5, 1, 0, "starting"))


def test_without_a_watchdog_or_with_another_process_s_it_is_not_fed(manager):
    address, told = manager
    for environment in ({}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}):
        with running(consumer := notifier(address, **environment)):
            consumer.handle([])
        assert "WATCHDOG=1" not in told() and consumer.tick_s == 1.0


def test_a_status_is_one_line_of_bounded_length():
    long = Snapshot("0", 1, "x", 5, 5, 1, 0, "degraded", ("y" * 5000,))
    assert len(status_of(long)) <= 400 and "\n" not in status_of(long)


@pytest.mark.parametrize(
    "environment", [{"NOTIFY_SOCKET": "relative"}, {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1 s"}]
)
def test_what_systemd_never_says_is_refused(environment):
    with pytest.raises(ConfigError, match=r"^systemd: "):
        Systemd("systemd", None, environment)


def test_a_real_daemon_tells_a_manager_that_goes_and_comes(manager, tmp_path, monkeypatch):
    address, told = manager
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    file = tmp_path / "robot.toml"
    file.write_text(SMALL + f'[log]\nfile = "{tmp_path}/log"\n')
    loaded = load_config(file)
    check_config(loaded)
    daemon = Daemon(loaded)
    daemon.start()
    lines = []
    until(lambda: lines.extend(told()) or ("READY=1" in lines and lines.count("WATCHDOG=1") > 1))
    assert daemon.stop() == []
    lines += told()
    assert lines.index("READY=1") < lines.index("STOPPING=1")
    assert "STATUS=running: 1 source, 0 models, 0 publishers" in lines


def configured(tmp_path, text=""):
    file = tmp_path / "robot.toml"
    file.write_text(SMALL + text)
    return file, load_config(file).config


def test_the_unit_opens_what_the_configuration_writes_and_nothing_else(tmp_path):
    file, config = configured(
        tmp_path,
        '[recorder]\nfolder = "my recordings"\n[log]\nfile = "logs/d.log"\n'
        '[[publisher]]\nkind = "jsonl"\noptions = { file = "out/a.jsonl" }\n',
    )
    folders = [tmp_path / "logs", tmp_path / "my recordings", tmp_path / "out"]
    assert written_folders(config) == folders
    unit = unit_text([sys.executable, "run", str(file)], config, "tactile")
    lines = unit.splitlines()
    assert f'ReadWritePaths="{tmp_path}/my recordings"' in lines
    assert [x for x in lines if x.startswith("ReadWritePaths")] == [
        f"ReadWritePaths={tmp_path}/logs", f'ReadWritePaths="{tmp_path}/my recordings"',
        f"ReadWritePaths={tmp_path}/out",
    ]  # fmt: skip
    for line in (
        "Type=notify", "NoNewPrivileges=yes", "ProtectSystem=strict", "DevicePolicy=closed",
        "DeviceAllow=char-ttyACM rw", "WatchdogSec=15", "RestartPreventExitStatus=2 3",
        "User=tactile", "CapabilityBoundingSet=",
    ):  # fmt: skip
        assert line in lines
    script = install_script(
        "tactile-rt.service", ["/opt/t r/tactile-rt", "config", "check", "x"], config, "tactile"
    )
    assert "\n'/opt/t r/tactile-rt' config check x\n" in script
    assert f"install -d -o tactile -g tactile '{tmp_path}/my recordings'" in script
    assert subprocess.run(["sh", "-n"], input=script, text=True, check=False).returncode == 0


def test_what_means_something_in_a_unit_is_kept_from_it(tmp_path):
    _, config = configured(tmp_path)
    unit = unit_text(["/bin/a b", "100%", "$HOME", 'q"'], config, "u")
    assert r'ExecStart="/bin/a b" 100%% $$HOME "q\""' in unit.splitlines()
    with pytest.raises(ConfigError, match="unit file"):
        unit_text(["/bin/a\nExecStart=/bin/evil"], config, "u")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd here")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    file, config = configured(tmp_path, '[recorder]\nfolder = "my recordings"\n')
    unit = tmp_path / "tactile-rt.service"
    unit.write_text(unit_text([sys.executable, "run", str(file)], config, "root"))
    command = ["systemd-analyze", "verify", "--man=no"]
    done = subprocess.run([*command, str(unit)], capture_output=True, text=True, check=False)
    ours = [x for x in (done.stdout + done.stderr).splitlines() if "tactile-rt.service" in x]
    assert ours == []
    # And it does look: a wrong line is found.
    unit.write_text(unit.read_text().replace("ProtectSystem=strict", "ProtectSystem=strictly"))
    done = subprocess.run([*command, str(unit)], capture_output=True, text=True, check=False)
    assert "strictly" in done.stdout + done.stderr


def test_install_service_writes_all_three_and_touches_nothing_else(tmp_path, monkeypatch, capsys):
    file, _ = configured(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["tactile-rt", "install-service", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code or 0, *capsys.readouterr()

    code, out, err = call(file, "--to", tmp_path / "to")
    assert code == 0, err
    assert "sudo sh" in out
    written = {p.name for p in (tmp_path / "to").iterdir()}
    assert written == {"tactile-rt.service", "99-tactile.rules", "install.sh"}
    assert f"{file}" in (tmp_path / "to" / "tactile-rt.service").read_text()
    assert "latency_timer" in (tmp_path / "to" / "99-tactile.rules").read_text()
    code, _, err = call(file, "--to", tmp_path / "to")
    assert code == 2 and "is there already" in err
    code, _, err = call(file, "--to", tmp_path / "new", "--user", "a; rm -rf /")
    assert code == 2 and "--user" in err and not (tmp_path / "new").exists()
    file.write_text("version = 2\n")
    code, _, err = call(file, "--to", tmp_path / "new")
    assert code == 2 and "robot.toml:1" in err and not (tmp_path / "new").exists()
