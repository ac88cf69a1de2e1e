"""A folder is one process's; what daemons lock is in `tests/daemon/test_parts.py`."""

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import alone_in
from tests.helpers.holding import held_elsewhere


def test_a_folder_is_one_process_s_by_all_its_names(tmp_path, monkeypatch):
    folder, other = tmp_path / "run", tmp_path / "link"
    other.symlink_to(folder)  # which is not there yet
    monkeypatch.chdir(tmp_path)
    with held_elsewhere(folder) as pid:
        for name in (folder, other, folder.relative_to(tmp_path)):
            with pytest.raises(ConfigError) as refusal, alone_in(name):
                pytest.fail("two have it")
            assert f"folder {folder} is in use by process {pid}: " in str(refusal.value)
        with alone_in(tmp_path), alone_in(folder / "probe"):  # above and below: other folders
            pass
    with alone_in(folder):
        assert not folder.exists(), "nothing is written"


def test_a_folder_is_free_again_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), alone_in(tmp_path):
            raise ZeroDivisionError
