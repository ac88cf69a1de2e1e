"""The example in docs/: a model file needs numpy and onnxruntime, and nothing of ours."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from tactile_rt.classifier.model_card import choose_label
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.classifier.stepper import Stepper

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "plain_onnxruntime.py"

# Anything else is as if it were not installed.
ALONE = """
import runpy, sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in {*sys.stdlib_module_names, "numpy", "onnxruntime"}:
            raise ModuleNotFoundError(f"blocked: {name}", name=name)
sys.meta_path.insert(0, Blocked())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def ours() -> list[str]:
    """What the example prints, computed the way the classifier does."""
    session, card = load_model(shipped_model())
    stepper = Stepper(session, card)
    shape, floor = card.array.shape, np.array(card.floor, dtype=np.float32)
    rng = np.random.default_rng(0)
    quiet = rng.normal(size=(50, *shape)).astype(np.float32) * floor
    stepper.begin(quiet.mean(axis=0), np.maximum(quiet.std(axis=0), floor))
    lines = []
    for step in range(card.steps):
        samples = rng.normal(size=(1, card.substeps, *shape)).astype(np.float32)
        stepper.samples[:] = samples * (10 * floor)
        evidence = stepper.run()[0] / card.temperature
        posterior = np.exp(evidence - evidence.max())
        posterior /= posterior.sum()
        best = choose_label(card, posterior, step + 1)
        lines.append(f"step {step + 1:2d}: {card.labels[best]} {posterior[best]:.2f}")
    return lines


def test_it_runs_alone_and_decides_as_we_do() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE, EXAMPLE, shipped_model()],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == ours()


def test_it_is_short() -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 40


def test_without_a_file_it_says_what_it_is_and_how_to_get_one() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE, EXAMPLE], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert "python plain_onnxruntime.py FILE" in done.stderr
    assert "shipped_model" in done.stderr and "Traceback" not in done.stderr
