"""Files and folders that are there whole or not at all."""

import errno
import os
import stat
import subprocess
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import (
    POINTER,
    open_regular,
    refuse_lfs_pointer,
    replace_file,
    replace_folder,
    sync_folder,
    write_whole,
)


@pytest.fixture
def umask():
    """Set it, and set it back."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


@pytest.mark.parametrize(("mask", "file", "folder"), [(0o022, 0o644, 0o755), (0o077, 0o600, 0o700)])
def test_what_is_written_is_as_private_as_its_user_wants(umask, tmp_path, mask, file, folder):
    umask(mask)
    write_whole(tmp_path / "a.json", lambda out: out.write(b"{}"))
    with replace_folder(tmp_path / "bag") as made:
        (made / "b").write_bytes(b"")
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == file
    assert stat.S_IMODE((tmp_path / "bag").stat().st_mode) == folder
    assert stat.S_IMODE((tmp_path / "bag" / "b").stat().st_mode) == file


def test_a_failure_names_the_file_that_was_to_be_and_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"before")

    def full(out):
        out.write(b"half")
        raise OSError(errno.ENOSPC, "of a system call, which names nothing")

    with pytest.raises(OSError, match="No space left on device") as failed:
        write_whole(path, full)
    assert failed.value.filename == str(path)
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["a.json"]


def test_where_nothing_can_be_made_the_name_is_the_one_that_was_given(tmp_path):
    path = tmp_path / "none" / "a"
    with pytest.raises(FileNotFoundError) as failed:
        write_whole(path, lambda out: None)
    assert failed.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as failed, replace_folder(path):
        pass
    assert failed.value.filename == str(path)


def test_a_failure_in_a_hidden_folder_names_what_it_was_to_be(tmp_path):
    with pytest.raises(FileNotFoundError) as failed, replace_folder(tmp_path / "bag") as made:
        (made / "none" / "a").write_bytes(b"")
    assert failed.value.filename == str(tmp_path / "bag")
    assert os.listdir(tmp_path) == []


def test_a_folder_is_replaced_whole_or_stays(tmp_path):
    path = tmp_path / "bag"
    path.mkdir()
    (path / "old").write_bytes(b"")
    with pytest.raises(ZeroDivisionError), replace_folder(path) as made:
        (made / "new").write_bytes(b"")
        raise ZeroDivisionError
    assert os.listdir(path) == ["old"]
    with replace_folder(path) as made:
        (made / "new").write_bytes(b"")
    assert os.listdir(path) == ["new"] and os.listdir(tmp_path) == ["bag"]


def test_what_is_no_file_is_written_into_and_stays_what_it_is(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(pipe, lambda out: out.write(b"{}"))
    assert os.read(reader, 10) == b"{}"
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]


@pytest.fixture
def read_only(tmp_path):
    """A folder of a file system that nothing can be written into."""
    mount = ["mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", str(tmp_path)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("only root mounts")
    yield tmp_path
    subprocess.run(["umount", "-l", str(tmp_path)], check=True)


def test_what_cannot_be_written_is_named_by_its_own_name(read_only):
    path = read_only / "mine.txt"
    with pytest.raises(OSError) as whole:
        write_whole(path, lambda file: file.write(b"x"))
    with pytest.raises(OSError) as slow, replace_file(path):
        pass
    with pytest.raises(OSError) as folder, replace_folder(path):
        pass
    assert {e.value.filename for e in (whole, slow, folder)} == {str(path)}


def test_an_error_about_another_file_stays_one_of_that_file(tmp_path):
    with pytest.raises(FileNotFoundError) as failed:
        write_whole(tmp_path / "a", lambda out: (tmp_path / "other").read_bytes())
    assert failed.value.filename == str(tmp_path / "other")
    with pytest.raises(OSError, match="No space") as failed:
        write_whole(Path("/dev/full"), lambda out: out.write(b"x"))
    assert failed.value.filename == "/dev/full"


def test_a_file_is_on_the_medium_before_it_has_its_name(tmp_path, monkeypatch):
    path, seen = tmp_path / "a.pt", []
    partial = tmp_path / "a.partial"
    monkeypatch.setattr(os, "fsync", lambda _: seen.append((partial.read_bytes(), path.exists())))
    with replace_file(path) as file:
        file.write(b"whole")
    assert seen == [(b"whole", False)] and path.read_bytes() == b"whole"


def test_a_folder_is_synced_by_a_handle_that_is_closed_again(tmp_path, monkeypatch):
    synced, open_before = [], os.listdir("/proc/self/fd")
    monkeypatch.setattr(os, "fsync", lambda n: synced.append(os.readlink(f"/proc/self/fd/{n}")))
    sync_folder(tmp_path)
    assert synced == [str(tmp_path)] and os.listdir("/proc/self/fd") == open_before
    (tmp_path / "a").touch()
    with pytest.raises(NotADirectoryError):
        sync_folder(tmp_path / "a")


@pytest.mark.parametrize("code, fails", [(errno.EINVAL, False), (errno.EIO, True)])
def test_only_a_file_system_that_cannot_sync_folders_is_excused(tmp_path, monkeypatch, code, fails):
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(code, "of the disk")))
    with pytest.raises(OSError) if fails else nullcontext():
        sync_folder(tmp_path)


def test_a_pipe_is_refused_unopened_and_without_waiting_if_it_has_just_come(tmp_path, monkeypatch):
    pipe, file = tmp_path / "pipe", tmp_path / "a"
    os.mkfifo(pipe)
    file.touch()
    was, open_before = os.stat(file), os.listdir("/proc/self/fd")
    for name, fake in (("open", lambda *_: pytest.fail("opened")), ("stat", lambda _: was)):
        with monkeypatch.context() as patch, pytest.raises(OSError, match="a pipe"):
            patch.setattr(os, name, fake)
            open_regular(pipe)
    assert os.listdir("/proc/self/fd") == open_before


def test_a_pointer_to_a_file_is_refused_as_one(tmp_path):
    pointer = tmp_path / "a.glb"
    pointer.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    for refuse in (open_regular, refuse_lfs_pointer):
        with pytest.raises(ConfigError) as refused:
            refuse(pointer)
        assert POINTER in str(refused.value)
