"""`tactile-rt bench`: areas, figures, the JSON form."""

import json
import os
import subprocess
import sys

import pytest

from bench.drivers import fuzzing, losses, unplugging
from bench.inference import area as inference
from tactile_rt.cli import bench


def test_an_unknown_area_lists_the_areas(refused):
    said = refused("bench", "speed")
    assert "there are sim, drivers, models, inference, daemon, align, perception" in said


def ask(code, folder, *path):
    """What Python says from a folder, with these on its path."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.fixture
def strange(tmp_path):
    """A folder with a `bench` that is not ours."""
    folder = tmp_path / "strange"
    (folder / "bench").mkdir(parents=True)
    (folder / "bench" / "__init__.py").write_text("raise SystemExit('not mine')\n")
    return folder


def test_without_the_rigs_it_is_one_line(strange):
    """As a wheel is installed: the package, and nothing of ours beside it."""
    (strange / "tactile_rt").symlink_to(bench.CHECKOUT / "tactile_rt", target_is_directory=True)
    main = "import sys; sys.argv[1:] = {}; from tactile_rt.cli import main; main()"
    for arguments in (["bench", "align", "--quick"], ["bench"]):
        done = ask(main.format(arguments), strange, strange)
        assert (done.returncode, done.stdout) == (2, "")
        assert "measures from a checkout" in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("area", bench.AREAS)
def test_each_area_is_found_from_any_folder(area, strange):
    code = f"from tactile_rt.cli import bench; rig = bench._load_rig({area!r}); print(rig.__file__)"
    done = ask(code, strange, strange, bench.CHECKOUT)
    assert done.stdout.strip() == str(bench.CHECKOUT / "bench" / area / "area.py"), done.stderr


def test_a_folder_that_is_not_there_is_named_before_measuring(refused, tmp_path):
    said = refused("bench", "inference", "--json", tmp_path / "not" / "figures.json")
    assert f"no folder {tmp_path / 'not'}" in said


def test_inference_loses_no_sample_uncounted(call, tmp_path, monkeypatch):
    monkeypatch.setattr(inference, "window_speed", lambda quick: [])  # it exports: a slow test
    code, out, _ = call("bench", "inference", "--quick", "--json", tmp_path / "figures.json")
    figures = {r["name"]: r for r in json.loads((tmp_path / "figures.json").read_text())}
    assert code == 0
    assert "of 7 requirements met" in out
    assert figures["inference.slow_dropped"]["value"] > 0  # the consumer was too slow
    assert figures["inference.slow_uncounted"]["value"] == 0
    assert figures["inference.size"]["met"]
    assert figures["inference.full_size"]["value"] == 0
    assert "quick" in figures["inference.full_size"]["how"]
    assert 0 < figures["inference.step_p50"]["value"] <= figures["inference.step_p99"]["value"]


CERTAIN = ("lost", "loss", "stale", "left_over", "exceptions", "held", "uneven", "resync", "lock")


def test_drivers_account_for_every_sample_and_leave_nothing(monkeypatch):
    monkeypatch.setattr(losses, "QUICK", 2500)
    monkeypatch.setattr(losses, "RUNS", {"slcan_int16": losses.RUNS["slcan_int16"]})
    monkeypatch.setattr(unplugging, "QUICK", 3)
    monkeypatch.setattr(fuzzing, "QUICK", 5000)
    parts = (losses.losses, unplugging.unplugging, fuzzing.fuzzing)
    records = [r for part in parts for r in part(quick=True) if r.bar and "clock" not in r.name]
    # Those that do not depend on who else uses the machine.
    figures = {r.name: r for r in records if any(word in r.name for word in CERTAIN)}
    assert len(figures) == 8
    assert all(r.met for r in figures.values()), [r for r in figures.values() if not r.met]
    assert "dropped" in figures["drivers.loss.slcan_int16"].how  # something did go wrong
