"""The short form of `bench/checks/long_run.py`: the shipped model through every kind of fault.

Each run has a process of its own: in one whose heap is full of holes left by other tests, nothing
that is kept shows in resident memory.
"""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tactile_rt.classifier.classifier import ENDLESS, IMPLAUSIBLE_LOADS
from tests.helpers.source_tree import ROOT

SCRIPT = ROOT / "bench" / "checks" / "long_run.py"

LEAKS = """
kept = []

class Leaks(long_run.Classifier):
    def push(self, chunk):
        kept.append(b"x" * 1_000_000)
        return super().push(chunk)

long_run.Classifier = Leaks
"""

FORGETS = '''
class Forgets(long_run.Classifier):
    """A state that is not what it is in a fresh one after so many steps."""

    def push(self, chunk):
        found = super().push(chunk)
        if self.stats.steps > 700:
            for d in found:
                d.probabilities[:] = d.probabilities[::-1].copy()
        return found

long_run.Classifier = Forgets
'''


@pytest.fixture(scope="module", autouse=True)
def _needed() -> None:
    if not SCRIPT.exists() or not Path("/proc/self/statm").exists():
        pytest.skip("needs the repository's bench folder and /proc")


def run(steps: int, warm_up: int, fault: str = "") -> tuple[int, str]:
    """Its exit status and what it said; `fault` is Python that breaks it first."""
    code = (
        f"import sys; sys.path.insert(0, {str(SCRIPT.parents[2])!r})\n"
        "from bench.checks import long_run\n"
        "long_run.GROWTH = 4e6  # the heap has not settled yet\n"
        f"{fault}\n"
        f"sys.exit(long_run.main(steps={steps}, warm_up={warm_up}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    told = done.stderr.splitlines()  # once by each: values past the clip are among the faults
    assert all(line.endswith((IMPLAUSIBLE_LOADS, ENDLESS)) for line in told)
    return done.returncode, done.stdout


def test_after_faults_of_every_kind_decisions_are_as_in_a_fresh_classifier() -> None:
    status, said = run(steps=1500, warm_up=1000)
    assert status == 0, said
    assert " 0 bad steps" in said
    assert "as in a fresh classifier, posteriors within 0.0e+00" in said


def test_the_faults_are_there() -> None:
    """Or the test above would say nothing."""
    spec = importlib.util.spec_from_file_location("long_run", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    long_run: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(long_run)
    np, weather = long_run.np, long_run.Weather(1)
    with np.errstate(all="ignore"):
        values = np.concatenate([weather.block(bad=True) for _ in range(12)])
        size = abs(values)
        tiny = np.finfo(np.float32).tiny
        assert np.isnan(values).any()
        assert np.isinf(values).any()
        assert ((size > 0) & (size < tiny)).any()  # denormals
        assert ((size > 100 * np.array(long_run.CARD.clip)) & (size < 1e6)).any()
        assert (values[:, :, 0].reshape(12, -1, values.shape[1]) == 0).all(axis=1).any()  # dead
    plain = weather.block(bad=False)
    assert np.isfinite(plain).all()


@pytest.mark.parametrize(
    ("fault", "found"),
    [(LEAKS, "decisions as in a fresh classifier"), (FORGETS, r"posteriors within (?!0\.0e\+00)")],
)
def test_growth_and_other_decisions_are_found(fault: str, found: str) -> None:
    status, said = run(400, 300, fault)
    assert status == 1 and re.search(found, said), said
