"""A folder is one process's; what daemons lock is in `tests/daemon/test_parts.py`."""

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import alone_in, device_keys
from tests.helpers.holding import held_elsewhere


def test_a_folder_is_one_process_s_by_all_its_names(cwd):
    folder, other = cwd / "run", cwd / "link"
    other.symlink_to(folder)  # which is not there yet
    with held_elsewhere(folder) as pid:
        for name in (folder, other, folder.relative_to(cwd)):
            with pytest.raises(ConfigError) as refusal, alone_in(name):
                pytest.fail("two have it")
            assert f"folder {folder} is in use by process {pid}: " in str(refusal.value)
        with alone_in(cwd), alone_in(folder / "probe"):  # above and below: other folders
            pass
    with alone_in(folder):
        assert not folder.exists(), "nothing is written"


def test_a_folder_is_free_again_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), alone_in(tmp_path):
            raise ZeroDivisionError


def test_a_device_has_one_key_by_all_its_names(cwd):
    (cwd / "tty0").touch()
    (cwd / "port").symlink_to("tty0")
    (cwd / "vcan0").touch()
    port = [f"device {cwd / 'tty0'}"]
    assert device_keys([f"serial:{cwd}/port?baud=9600", "serial:port", "serial:tty0"]) == port
    assert device_keys(["can:slcan:port", f"can:slcan:{cwd}/tty0"]) == port
    # A bus is no file, though there is one of its name; a port may not be there yet.
    found = device_keys(["can:vcan0", "serial:port1", "sim:mouse"])
    assert found == ["device vcan0", "device port1"]
