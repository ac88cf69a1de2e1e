"""`tactile-rt bench`: areas, figures, the JSON form."""

import json


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
