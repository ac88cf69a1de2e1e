"""What is compiled is kept where that is possible, and nothing else depends on it."""

import errno
import importlib.util
import logging
from pathlib import Path

import pytest
from numba.core.caching import FunctionCache, IndexDataCacheFile

from tactile_rt.sim_backend.rods import compiled as module

TEXT = """\
from tactile_rt.sim_backend.rods.compiled import compile_cached


@compile_cached
def doubled(x):
    return 2 * x
"""


@pytest.fixture
def doubled(tmp_path):
    """Import a module of one compiled function anew, as another process would."""
    file = tmp_path / "doubling.py"
    file.write_text(TEXT)

    def load():
        spec = importlib.util.spec_from_file_location("doubling", file)
        made = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(made)
        return made.doubled

    return load


def kept(folder: Path, suffix: str) -> list[Path]:
    return list((folder / "__pycache__").glob(f"*{suffix}"))


def from_disk(function) -> bool:
    return sum(function.stats.cache_hits.values()) > 0


def test_the_next_process_does_not_compile(doubled):
    assert doubled()(2.0) == 4.0
    again = doubled()
    assert again(2.0) == 4.0 and from_disk(again)


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("left", [0, 40])
def test_damage_is_compiled_over(doubled, tmp_path, suffix, left):
    assert doubled()(2.0) == 4.0
    (file,) = kept(tmp_path, suffix)
    file.write_bytes(file.read_bytes()[:left])
    again = doubled()
    assert again(2.0) == 4.0 and not from_disk(again)
    healed = doubled()
    assert healed(2.0) == 4.0 and from_disk(healed)


def test_what_another_release_compiled_is_old(doubled, monkeypatch):
    assert doubled()(2.0) == 4.0
    monkeypatch.setattr(module, "STAMP", ())
    again = doubled()
    assert again(2.0) == 4.0 and not from_disk(again)


def test_a_full_disk_keeps_nothing(doubled, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    assert doubled()(2.0) == 4.0
    assert kept(tmp_path, ".nbi") == []


def test_compilation_that_lasts_is_said_and_what_was_kept_is_not(doubled, monkeypatch, caplog):
    class Due:
        """A timer that is over at once."""

        def __init__(self, seconds, function):
            self.start = function

    monkeypatch.setattr(module.threading, "Timer", Due)
    said = []
    for _ in range(2):
        module._watch_once.cache_clear()
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert doubled()(2.0) == 4.0
        said.append("compiling the simulator" in caplog.text)
    assert said == [True, False]
    caplog.clear()
    module._warn_of_compilation()  # what was compiled is compiled no more
    assert not caplog.records


def test_without_a_folder_it_is_said_once(doubled, monkeypatch, caplog):
    def no_place(self, function):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(FunctionCache, "__init__", no_place)
    module._warn_uncached_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert doubled()(2.0) == doubled()(2.0) == 4.0
    assert [r.message for r in caplog.records if "NUMBA_CACHE_DIR" in r.message] == [
        "the simulator is compiled anew, which takes half a minute: there is no folder to keep it "
        "in; NUMBA_CACHE_DIR can name one"
    ]
