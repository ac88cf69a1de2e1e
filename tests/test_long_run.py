"""The short form of `bench/long_run.py`: the shipped model through every kind of trouble."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "bench" / "long_run.py"


@pytest.fixture(scope="module")
def long_run() -> ModuleType:
    if not SCRIPT.exists() or not Path("/proc/self/statm").exists():
        pytest.skip("needs the repository's bench folder and /proc")
    spec = importlib.util.spec_from_file_location("long_run", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.GROWTH = 4e6  # the heap has not settled yet
    return module


def test_after_troubles_of_every_kind_decisions_are_as_in_a_fresh_classifier(
    long_run: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert long_run.main(steps=1500, warm_up=1000) == 0
    said = capsys.readouterr().out
    assert " 0 bad steps" in said
    assert "as in a fresh classifier, posteriors within 0.0e+00" in said


def test_the_troubles_are_there(long_run: ModuleType) -> None:
    """Or the test above would say nothing."""
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


def test_growth_and_other_decisions_are_found(
    long_run: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = []

    class Leaks(long_run.Classifier):
        def push(self, chunk):
            kept.append(b"x" * 1_000_000)
            return super().push(chunk)

    with monkeypatch.context() as patch:
        patch.setattr(long_run, "Classifier", Leaks)
        assert long_run.main(steps=400, warm_up=300) == 1
    assert kept

    class Forgets(long_run.Classifier):
        """A state that is not what it is in a fresh one after so many steps."""

        def push(self, chunk):
            found = super().push(chunk)
            if self.stats.steps > 700:
                for d in found:
                    d.probabilities[:] = d.probabilities[::-1].copy()
            return found

    monkeypatch.setattr(long_run, "Classifier", Forgets)
    assert long_run.main(steps=400, warm_up=300) == 1
