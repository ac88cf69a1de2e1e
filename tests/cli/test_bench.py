"""`tactile-rt bench`: areas, figures, the JSON form."""

import json

from tactile_rt.benchmarks.drivers import fuzzing, losses, unplugging, wires


def test_an_unknown_area_lists_the_areas(call):
    code, _, err = call("bench", "speed")
    assert code == 2
    assert "there are sim, drivers, models, inference, daemon, align" in err
    assert err.count("\n") == 1


def test_an_area_without_figures_says_so(call):
    assert call("bench", "align") == (0, "no figures yet for: align\n", "")


def test_a_folder_that_is_not_there_is_named_before_measuring(call, tmp_path):
    code, _, err = call("bench", "inference", "--json", tmp_path / "not" / "figures.json")
    assert code == 2
    assert f"no folder {tmp_path / 'not'}" in err


def test_inference_loses_no_sample_uncounted(call, tmp_path):
    code, out, _ = call("bench", "inference", "--quick", "--json", tmp_path / "figures.json")
    figures = {r["name"]: r for r in json.loads((tmp_path / "figures.json").read_text())}
    assert code == 0
    assert "of 5 bars met" in out
    assert figures["inference.slow_dropped"]["value"] > 0  # the consumer was too slow
    assert figures["inference.slow_uncounted"]["value"] == 0
    assert figures["inference.size"]["met"]
    assert 0 < figures["inference.step_p50"]["value"] <= figures["inference.step_p99"]["value"]


def test_the_drivers_lose_nothing_and_say_what_they_lost(monkeypatch):
    monkeypatch.setattr(losses, "QUICK", 2500)
    runs = {name: losses.RUNS[name] for name in ("serial_float32", "slcan_int16")}
    monkeypatch.setattr(losses, "RUNS", runs)
    monkeypatch.setattr(unplugging, "QUICK", 3)
    monkeypatch.setattr(fuzzing, "QUICK", 5000)
    monkeypatch.setattr(wires, "SERIAL_QUICK_S", 1.5)
    monkeypatch.setattr(wires, "CAN_QUICK_S", 1.5)
    monkeypatch.setattr(wires, "FAST_QUICK_S", 0.5)
    parts = (wires.serial, wires.can, losses.losses, unplugging.unplugging, fuzzing.fuzzing)
    figures = {record.name: record for part in parts for record in part(quick=True)}
    certain = ("lost", "loss", "stale", "left_over", "exceptions", "held", "uneven", "resync")
    kept = [r for name, r in figures.items() if any(word in name for word in certain)]
    assert len(kept) == 11
    assert all(record.met for record in kept), [r for r in kept if not r.met]
    assert figures["drivers.serial.cpu"].value > 0  # how fast depends on who else is here
    assert "dropped" in figures["drivers.loss.serial_float32"].how  # something did go wrong
