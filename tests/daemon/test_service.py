"""The service's unit, and the script that installs it, run by root on a copy of the system."""

import json
import os
import shlex
import shutil
import subprocess
import sys

import pytest

from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.loading import load_config
from tactile_rt.daemon.service import unit_text
from tests.helpers.overlay import changes

SMALL = 'version = 1\n[[source]]\nname = "a"\nurl = "synthetic:2x2"\n'


def configured(tmp_path, text=""):
    file = tmp_path / "robot.toml"
    file.write_text(SMALL + text)
    return file, load_config(file).config


def test_the_unit_opens_folders_of_the_services_own_and_nothing_else(tmp_path):
    file, config = configured(
        tmp_path, recorder("/var/lib/tactile-rt/rec") + log("/var/log/tactile-rt/d.log")
    )
    check_config(load_config(file))  # a folder that systemd will make need not be there
    lines = unit_text([sys.executable, "run", str(file)], config, "tactile").splitlines()
    assert {"StateDirectory=tactile-rt", "LogsDirectory=tactile-rt"} <= {*lines}
    assert not any(x.startswith(("ReadWritePaths", "RuntimeDirectory")) for x in lines)


def test_what_means_something_in_a_unit_is_kept_from_it(tmp_path):
    _, config = configured(tmp_path)
    unit = unit_text(["/bin/a b", "100%", "$HOME", 'q"'], config, "u")
    assert r'ExecStart="/bin/a b" 100%% $$HOME "q\""' in unit.splitlines()
    with pytest.raises(ConfigError, match="unit file"):
        unit_text(["/bin/a\nExecStart=/bin/evil"], config, "u")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd here")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    file, config = configured(tmp_path, recorder("/var/lib/tactile-rt/rec"))
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


def test_install_service_writes_all_three_and_touches_nothing_else(tmp_path, done, refused):
    file, _ = configured(tmp_path)
    out, _ = done("install-service", file, "--out", tmp_path / "to")
    assert "sudo sh" in out
    written = {p.name for p in (tmp_path / "to").iterdir()}
    assert written == {"tactile-rt.service", "99-tactile.rules", "install.sh"}
    assert f"{file}" in (tmp_path / "to" / "tactile-rt.service").read_text()
    assert "latency_timer" in (tmp_path / "to" / "99-tactile.rules").read_text()
    assert "already exists" in refused("install-service", file, "--out", tmp_path / "to")
    new = ("install-service", file, "--out", tmp_path / "new")
    assert "--user" in refused(*new, "--user", "a; rm -rf /")
    file.write_text("version = 2\n")
    assert "robot.toml:1" in refused(*new) and not (tmp_path / "new").exists()


# The script, as root, on a copy of the whole file system

CONFIG = "/etc/tactile/robot.toml"
TOOL = [sys.executable, "-B", "-c", "from tactile_rt.cli import main; main()"]
WRITE = shlex.join([*TOOL, "install-service", CONFIG, "--out"])
STUBS = "/opt/stubs"  # of what needs a running systemd; users and groups are real
RUN = f"PATH={STUBS}:$PATH sh /root/service/install.sh"
PREPARE = f"""
mkdir -p {STUBS} /etc/tactile /etc/udev/rules.d /etc/systemd/system
for tool in systemctl udevadm; do
    printf '#!/bin/sh\\necho {STUBS}/%s "$@"\\n' "$tool" > {STUBS}/$tool
    chmod 755 {STUBS}/$tool
done
"""
USER = "useradd --system --no-create-home --shell /usr/sbin/nologin --user-group tactile\n"
ACCOUNTS = {
    f"/etc/{name}{old}" for name in ("passwd", "shadow", "group", "gshadow") for old in ("", "-")
}
ACCOUNTS |= {"/etc/.pwd.lock", "/etc/subuid", "/etc/subuid-", "/etc/subgid", "/etc/subgid-"}
INSTALLED = {"/etc/systemd/system/tactile-rt.service", "/etc/udev/rules.d/99-tactile.rules"}


@pytest.fixture(scope="module")
def on_a_copy():
    """`changes`, where the system lets root have copies of itself."""
    if os.geteuid() != 0 or not shutil.which("unshare"):
        pytest.skip("needs root and unshare")
    try:
        tried = changes("true", shlex.join([*TOOL[:-1], "import tactile_rt"]))
    except OSError as error:
        pytest.skip(f"no overlay here: {error}")
    if tried.code:
        pytest.skip("this Python lies on another file system than /")
    assert tried.before == {}
    return changes


def recorder(folder):
    return f"[recorder]\nfolder = {json.dumps(folder)}\n"


def log(file):
    return f"[log]\nfile = {json.dumps(file)}\n"


def prepared(config="", before=""):
    """Shell: the stubs, what `before` makes, the configuration."""
    return f"{PREPARE}\n{before}\nprintf %s {shlex.quote(SMALL + config)} > {CONFIG}\n"


def written(config="", before="", after=""):
    """Shell: the same, the service, what `after` makes."""
    return f"{prepared(config, before)}{WRITE} /root/service\n{after}"


def check_installed(changed):
    assert changed.code == 0, changed.said
    assert INSTALLED <= set(changed.after) <= INSTALLED | ACCOUNTS
    for path in ACCOUNTS & set(changed.after):
        (was, now) = changed.before[path], changed.after[path]
        if was is None or now is None or path == "/etc/.pwd.lock":
            continue
        assert was[:3] == now[:3], path  # kind and mode, owner, group
        if not path.endswith("-"):
            lines = set(was[3].splitlines()) ^ set(now[3].splitlines())
            assert all("tactile" in x or x.startswith("dialout:") for x in lines), (path, lines)
    for path in INSTALLED:
        assert changed.after[path][:3] == ["-rw-r--r--", 0, 0]


def test_installing_changes_accounts_unit_and_rules_and_nothing_else(on_a_copy):
    changed = on_a_copy(written(), RUN)
    check_installed(changed)
    assert "\ntactile:" in changed.after["/etc/passwd"][3]
    assert f"{STUBS}/systemctl restart tactile-rt.service" in changed.said


def test_installing_again_changes_nothing(on_a_copy):
    keeps = recorder("/var/lib/tactile-rt/recordings")
    changed = on_a_copy(written(keeps, after=RUN), RUN)
    assert (changed.code, changed.after) == (0, {}), changed.said


def test_a_folder_of_the_services_own_is_left_as_it_is(on_a_copy):
    before = f"{USER}install -d -m 0700 -o tactile /var/lib/tactile-rt"
    check_installed(on_a_copy(written(recorder("/var/lib/tactile-rt/rec"), before), RUN))


OTHERS = "useradd bob; mkdir -m 0750 /srv/bobs; chown bob: /srv/bobs\n"
ALONE = "a service writes into /var/lib/tactile-rt or /var/log/tactile-rt or /run/tactile-rt alone"
REFUSED = [
    (log("/tmp/d.log"), "", f"log.file: folder /tmp: {ALONE}"),
    (log("d.log"), "", f"log.file: folder /etc/tactile: {ALONE}"),
    (recorder("/var/lib/tactile-rt/../../etc"), "", ALONE),
    (
        recorder("/var/lib/tactile-rt/rec"),
        f"{OTHERS}install -d /var/lib/tactile-rt; ln -s /srv/bobs /var/lib/tactile-rt/rec", ALONE,
    ),
    (
        '[[publisher]]\nkind = "jsonl"\noptions = { file = "/srv/bobs/out" }\n', OTHERS,
        f"publisher[0].options.file: folder /srv/bobs: {ALONE}",
    ),
    (
        '[[source]]\nname = "b"\nurl = "synthetic:mouse"\n'
        '[[model]]\nsource = "b"\nfile = "/var/lib/tactile-rt/m.onnx"\n',
        "mkdir /var/lib/tactile-rt; "
        f"cp {shlex.quote(str(shipped_model()))} /var/lib/tactile-rt/m.onnx",
        "the service would own /var/lib/tactile-rt/m.onnx, which it only reads",
    ),
    (
        "", f"{OTHERS}mv /srv/bobs /var/lib/tactile-rt",
        "folder /var/lib/tactile-rt: user tactile must own it",
    ),
    ("", f"{OTHERS}ln -s /srv/bobs /run/tactile-rt", "folder /run/tactile-rt: user tactile must"),
]  # fmt: skip


def test_a_folder_that_is_not_the_services_is_refused_before_anything_is_written(on_a_copy):
    """All in one copy: each is written, refused in one line, and nothing is left of it."""
    for config, before, said in REFUSED:
        changed = on_a_copy(prepared(config, before), f"{WRITE} /root/service")
        assert changed.code == 2 and changed.said.count("\n") == 1, (config, changed.said)
        assert said in changed.said and changed.after == {}, (config, changed)


@pytest.mark.parametrize(
    ("meanwhile", "said"),
    [
        (f"{OTHERS}mv /srv/bobs /var/lib/tactile-rt", "user tactile must own it"),
        (
            f"echo {shlex.quote(log('/var/log/tactile-rt/d'))} >> {CONFIG}",
            "now gives another tactile-rt.service",
        ),
        (f"echo nonsense >> {CONFIG}", "the configuration cannot be installed"),
        ("groupdel dialout", "there is no group dialout"),
        ("rm -r /etc/udev/rules.d", "there is no folder /etc/udev/rules.d"),
        (
            f"rm {STUBS}/udevadm; while tool=$(command -v udevadm); do rm $tool; done",
            "there is no udevadm here",
        ),
    ],
)
def test_what_has_changed_since_is_seen_before_anything_is_changed(on_a_copy, meanwhile, said):
    changed = on_a_copy(written(recorder("/var/lib/tactile-rt/rec"), after=meanwhile), RUN)
    assert (changed.code, changed.after) == (1, {}), changed.said
    assert said in changed.said and "nothing has been changed\n" in changed.said


def test_without_root_nothing_is_tried(on_a_copy):
    run = f"chmod 755 /root; exec setpriv --reuid 65534 --clear-groups sh -c {shlex.quote(RUN)}"
    changed = on_a_copy(written(after="chmod 755 /root"), run)
    assert changed.code == 1 and "run it as root" in changed.said and changed.after == {}
