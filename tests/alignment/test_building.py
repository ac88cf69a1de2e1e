"""Benchmarks from rates in the published layout, and requests that cannot be met."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.alignment import build
from tactile_rt.alignment.neural import read_published
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import install_extra
from tests.helpers.brains import geometry, padded
from tests.helpers.nwb_sessions import write_session
from tests.helpers.refusals import refusal


@pytest.fixture
def rates():
    rng = np.random.default_rng(0)
    shared = geometry(rng)
    return {f"sub-{i}": padded(rng, (20, 16), (9, 8), 3, shared) for i in range(3)}


def test_a_published_file_builds_a_paper_code_benchmark(rates, tmp_path):
    # As the published file: with an option that was saved as if it were an animal.
    np.savez(tmp_path / "rates.npz", allow_pickle_=np.array(True), **rates)
    with np.load(tmp_path / "rates.npz") as file:
        entries = {k.rstrip("_"): file[k] for k in file.files}
    np.savez_compressed(tmp_path / "rates.npz", **entries)
    made = build([tmp_path / "rates.npz"], "paper-code", bootstraps=30)
    assert [t.name for t in made.all_targets] == [*rates, "concatenated"]
    assert made.sources == ("rates.npz",)
    for name, array in read_published(tmp_path / "rates.npz").items():
        np.testing.assert_array_equal(array, rates[name])


def test_its_stimuli_have_no_names_so_strict_refuses_it(rates, tmp_path):
    np.savez_compressed(tmp_path / "rates.npz", **rates)
    assert "its stimuli have no names" in refusal(build, [tmp_path / "rates.npz"])
    with pytest.raises(ConfigError, match="give no other file"):
        build([tmp_path / "rates.npz", tmp_path], "paper-code")


def test_the_published_option_is_passed_over_and_never_unpickled(rates, tmp_path):
    """numpy saved `allow_pickle=True` among the animals; were it a pickle, it would stay one."""

    class Trap:
        def __reduce__(self):
            return Path(tmp_path / "sprung").touch, ()

    np.savez(tmp_path / "rates.npz", **rates)
    for entry in (np.array(True), np.array([Trap()], dtype=object)):
        with zipfile.ZipFile(tmp_path / "rates.npz", "a") as archive:
            if "allow_pickle.npy" not in archive.namelist():
                with archive.open("allow_pickle.npy", "w") as member:
                    np.lib.format.write_array(member, entry)
        made = build([tmp_path / "rates.npz"], "paper-code", bootstraps=30)
        assert [t.name for t in made.targets] == list(rates)
        assert made.notes == ("rates.npz: 3 animals, 51 units",)
        np.savez(tmp_path / "rates.npz", **rates)
    assert not (tmp_path / "sprung").exists()
    with pytest.raises(ConfigError, match="holds rates, not spikes: neither a clock nor a sel"):
        build([tmp_path / "rates.npz"], "paper-code", clock="session")


def test_an_animal_without_an_rdm_is_left_out_alone(rates, tmp_path):
    silent = {**rates, "silent": np.zeros_like(rates["sub-0"])}
    np.savez_compressed(tmp_path / "rates.npz", **silent)
    made = build([tmp_path / "rates.npz"], "paper-code", bootstraps=30)
    assert [t.name for t in made.targets] == list(rates)
    assert made.notes[1].startswith("animal silent: no RDM") and made.notes[1].endswith("left out")
    np.savez_compressed(tmp_path / "rates.npz", silent=silent["silent"])
    with pytest.raises(ConfigError, match="animal silent: no RDM"):
        build([tmp_path / "rates.npz"], "paper-code", bootstraps=30)


def test_a_build_without_reliable_animals_says_why(tmp_path):
    pytest.importorskip("h5py", reason="h5py reads the files")
    for i in range(2):  # units that answer to contact, and to all stimuli alike
        rng = np.random.default_rng(i)
        write_session(tmp_path / f"{i}.nwb", rng, np.full((6, 12), 7.0), f"mouse-{i}", trials=48)
    said = refusal(build, [tmp_path], bootstraps=30)
    assert re.match(
        r"no animal is reliable enough .*: mouse-0 (-?\d\.\d\d|nan) \(\d+ of 12 u", said
    )


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 5, 3)), r"m is float64 \(4, 5, 3\), not numbers \(row, 6 stimuli, unit\)"),
        (np.zeros((4, 6, 3), dtype="U1"), "not numbers"),
        (np.zeros((1, 6, 3)), "fewer than two rows or units"),
        (np.full((4, 6, 3), np.inf), "infinite rate"),
        (np.array([None]), "not an npz file of numbers"),
    ],
)
def test_arrays_of_another_shape_are_refused(tmp_path, array, message):
    np.savez_compressed(tmp_path / "rates.npz", m=array)
    with pytest.raises(ConfigError, match=message):
        read_published(tmp_path / "rates.npz")


def test_files_of_another_kind_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    assert "text.npz: not an npz file of numbers" in refusal(read_published, tmp_path / "text.npz")
    np.savez(tmp_path / "empty.npz")
    assert "holds no animal" in refusal(read_published, tmp_path / "empty.npz")
    assert "no file" in refusal(read_published, tmp_path / "none.npz")


def test_requests_that_cannot_be_met(tmp_path):
    with pytest.raises(ConfigError, match="no protocol 'loose': there are strict, paper-code"):
        build([tmp_path], "loose")
    assert "name NWB files" in refusal(build, [])
    assert "bootstraps must be 1 or more" in refusal(build, [tmp_path], bootstraps=0)


def test_without_h5py_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "a.nwb").touch()
    with pytest.raises(ConfigError, match=re.escape(install_extra("align"))):
        build([tmp_path / "a.nwb"])


def test_a_gate_needs_neither_h5py_nor_torch():
    code = (
        "import sys\n"
        "import types, tactile_rt\n"
        "from pathlib import Path\n"
        # The package above imports torch for the networks; alignment itself must not.
        "models = types.ModuleType('tactile_rt.models')\n"
        "models.__path__ = [str(Path(tactile_rt.__file__).parent / 'models')]\n"
        "sys.modules['tactile_rt.models'] = models\n"
        "import tactile_rt.alignment\n"
        "print(sorted({'torch', 'h5py', 'scipy', 'mujoco'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
