"""`tactile-rt hil`: a sweep compared, exit codes, mistakes of one line."""

import re
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import pytest

from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.tiny_model import write_model

SPEC = small_spec()
needs_sim = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")
pytestmark = pytest.mark.usefixtures("no_thread_left")


@needs_sim
def test_the_command_compares_a_sweep(call) -> None:
    code, out, err = call("hil", "--source", "sim:mouse?objects=mug-1&seed=2", "--sweeps", 1)
    assert (code, err) == (0, "")
    cells = [line.strip("│").split("│") for line in out.splitlines() if line[0] == "│"]
    rows = {key.strip(): value.strip() for key, value in cells}
    n = rows["samples"].split(",")[0]
    assert int(n) > 1500 and rows["identical samples"] == f"{n} of {n} (100.00 %)"
    assert rows["decisions"] == "22 direct, 22 through the driver"
    assert rows["identical decisions"] == rows["same labels"] == "22 of 22 (100.00 %)"


def test_unless_told_otherwise_objects_pass_that_the_model_has_never_met(call, monkeypatch):
    asked = []

    def refuse(url: str) -> None:
        asked.append(url)
        raise ConfigError("enough")

    monkeypatch.setattr("tactile_rt.sources.opening.open_source", refuse)
    assert call("hil")[0] == 2
    (url,) = asked
    options = dict(parse_qsl(url.partition("?")[2]))
    unseen = load_model(shipped_model())[1].provenance["unseen_objects"]
    assert url.startswith("sim:mouse?") and options["objects"].split(",") == unseen
    assert (options["sweeps"], options["pace"]) == ("6", "fast")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--wire", "usb"], "wire must be one of serial, slcan, virtual"),
        (["--set", "form=int16"], "no option 'form'; did you mean format?"),
        (["--source", "synthetic:", "--sweeps", 3], "--sweeps needs a sim: source"),
        (["--source", "synthetic:3x6?seconds=1"], "was made for another array"),
    ],
)
@needs_sim
def test_a_mistake_is_one_line(refused, arguments, said) -> None:
    assert said in refused("hil", *arguments)


def test_a_difference_is_exit_code_1(call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = write_model(tmp_path / "tiny.onnx")
    noise = np.random.default_rng(0).normal(size=(1000, *SPEC.shape)) * 2e-3
    source = ArraySource(SPEC, cut_chunks(noise, SPEC.rate_hz))
    monkeypatch.setattr("tactile_rt.sources.opening.open_source", lambda url: source)
    code, out, err = call("hil", "--source", "synthetic:3x2", "--model", model)
    assert code == 1 and "0 direct, 0 through the driver" in out
    assert "nothing was touched" in err and len(err.strip().splitlines()) == 1


@needs_sim
@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments", [(), ("--set", "format=int16"), ("--wire", "slcan")], ids=" ".join
)
def test_24_sweeps(call, arguments: tuple[str, ...]) -> None:
    """Bit-equal in float32; else 99 % of all decisions have the same label."""
    code, out, err = call("hil", "--sweeps", 24, *arguments)
    assert (code, err) == (0, "")
    direct, through = map(int, re.search(r"(\d+) direct, (\d+) through the driver", out).groups())
    assert direct == through >= 24 * 22, "some objects are felt twice"
