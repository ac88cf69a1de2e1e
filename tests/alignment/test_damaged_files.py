"""Recordings of which a bit is wrong: read, or refused in a line that names the file."""

from collections import Counter

import numpy as np
import pytest

from tactile_rt.alignment.clock import CLOCKS
from tactile_rt.alignment.neural import read_published
from tactile_rt.alignment.nwb import WINDOWS, read_session
from tactile_rt.core.errors import ConfigError
from tests.helpers.nwb_sessions import write_session

pytest.importorskip("h5py", reason="h5py reads the files")


def nwb_bytes(folder):
    rng = np.random.default_rng(0)
    return write_session(folder / "a.nwb", rng, rng.uniform(1, 9, (6, 4)), trials=18).read_bytes()


def npz_bytes(folder):
    rng = np.random.default_rng(0)
    np.savez_compressed(folder / "a.npz", m=rng.uniform(0, 9, (8, 6, 5)), n=np.ones((9, 6, 3)))
    return (folder / "a.npz").read_bytes()


def read_nwb_file(path, k):
    read_session(path, WINDOWS[k % 2], clock=CLOCKS[k // 2 % 2])


def read_npz_file(path, k):
    read_published(path)


def flips(folder, whole, read, name, number):
    """A file with a bit flipped, so many times."""
    rng = np.random.default_rng(0)
    path = folder / name
    for k in range(number):
        damaged = bytearray(whole)
        # HDF5 keeps what it says of its data in little of the file: every other flip is there.
        end = len(whole) if k % 2 else min(len(whole), 8192)
        damaged[rng.integers(end)] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        yield lambda k=k: read(path, k)


def outcome(read, name):
    """How reading ends, where a line that names the file is the only error allowed."""
    try:
        read()
    except ConfigError as error:
        return "refused" if name in str(error) and "\n" not in str(error) else "many lines"
    except BaseException as error:
        return repr(error)
    return "read"


FILES = pytest.mark.parametrize(
    ("made", "read", "name"),
    [(nwb_bytes, read_nwb_file, "b.nwb"), (npz_bytes, read_npz_file, "b.npz")],
)


@FILES
def test_a_flipped_bit_is_read_or_refused_in_a_line(tmp_path, made, read, name):
    found = Counter(outcome(one, name) for one in flips(tmp_path, made(tmp_path), read, name, 60))
    assert set(found) == {"read", "refused"}, found


@FILES
def test_a_file_that_ends_early_is_refused_in_a_line(tmp_path, made, read, name):
    whole = made(tmp_path)
    for length in np.linspace(0, len(whole) - 1, 25, dtype=int):
        (tmp_path / name).write_bytes(whole[:length])
        with pytest.raises(ConfigError, match=name) as error:
            read(tmp_path / name, 0)
        assert "\n" not in str(error.value)
