"""What is said of a window's speed is what was measured."""

import itertools

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

from bench.inference import window_speed as speed


@pytest.fixture
def takes(monkeypatch):
    """A window that takes so long, ms for each call, on a clock of its own."""
    now = [0.0]
    monkeypatch.setattr(speed.time, "thread_time", lambda: now[0])

    def window(milliseconds, logits):
        left = itertools.cycle(milliseconds)

        def run():
            now[0] += next(left) / 1e3
            return np.array(logits, dtype=np.float32)

        return run

    return window


def test_times_are_beside_the_plain_network_s_and_only_full_width_has_a_bar(takes):
    windows = {
        "plain": takes([900, 50, 40], [0.0, 4.0]),  # the first call warms up
        "torch": takes([900, 20, 30], [0.0, 4.0]),
        "fp32": takes([900, 16, 10], [0.0, 4.25]),
    }
    records = {r.name: r for r in speed._measured(windows, 1.0, 2)}
    assert records["inference.window.plain"].value == pytest.approx(40)
    assert records["inference.window.torch_times_plain"].value == pytest.approx(2)
    file = records["inference.window.fp32_times_plain"]
    assert file.value == pytest.approx(4)
    assert file.met
    assert "within 2.5e-01 of the plain ones, whose spread is 2" in file.how
    assert [name for name, r in records.items() if r.bar] == ["inference.window.fp32_times_plain"]
    assert not any(r.bar for r in speed._measured(windows, 0.125, 2))
    slow = speed._measured({**windows, "fp32": takes([20], [0.0, 4.0])}, 1.0, 2)
    assert [r.met for r in slow if r.bar] == [False]


@pytest.mark.slow
def test_all_four_compute_the_same_network():
    records = {r.name: r for r in speed.window_speed(quick=True)}
    assert len(records) == 7
    for name, bar in (("torch", 1e-5), ("fp32", 1e-5), ("int8", 0.1)):
        how = records[f"inference.window.{name}_times_plain"].how
        assert float(how.partition("logits within ")[2].split()[0]) <= bar
