"""`tactile-rt locate`: its errors, and a set from sweep to figures."""

import json

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("trimesh")

RECIPE = """
lead_ms = 90
length_ms = 540
[objects]
categories = ["mug"]
per_category = 3
validation = 1
test = 1
[sweeps]
draws = 1
gap_mm = 0.5
"""


def test_from_sweeps_to_figures(call, tmp_path):
    recipe, folder, checkpoint = (tmp_path / n for n in ("mine.toml", "set", "locate.pt"))
    recipe.write_text(RECIPE)
    options = ("--recipe", recipe, "--processes", 1, "--set", "contacts=true")
    assert call("sweep", folder, *options)[0] == 0
    code, _, err = call("locate", "train", folder, checkpoint, "--epochs", 2, "--set", "hidden=8")
    assert (code, "epoch 2/2" in err) == (0, True)
    figures = tmp_path / "figures.json"
    code, out, _ = call("locate", "eval", checkpoint, folder, "--json", figures)
    assert code == 0 and "contact.noisy.network.f1" in out
    names = [r["name"] for r in json.loads(figures.read_text())]
    assert len(names) == len(set(names))
    assert call("sweep", folder, "--processes", 1)[0] == 0  # goes on as it was begun
    whole = checkpoint.read_bytes()
    for words in (("train", folder, checkpoint), ("eval", checkpoint, folder)):
        code, _, err = call("locate", *words, "--json", checkpoint)
        assert code == 2 and "is another file of this command: name a new one" in err
    assert checkpoint.read_bytes() == whole


@pytest.mark.parametrize("arguments", [("train", "set", "x.pt"), ("eval", "x.pt", "set")])
def test_a_mistake_is_one_line(call, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    code, out, err = call("locate", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("tactile-rt: ") and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_set_without_contacts_is_told_how_to_get_them(call, tmp_path):
    recipe, folder = tmp_path / "mine.toml", tmp_path / "set"
    recipe.write_text(RECIPE.replace("540", "180"))
    assert call("sweep", folder, "--recipe", recipe, "--processes", 1)[0] == 0
    code, _, err = call("locate", "train", folder, tmp_path / "x.pt")
    assert code == 2 and "`tactile-rt sweep --set contacts=true`" in err
    assert err.count("\n") == 1 and not (tmp_path / "x.pt").exists()
    code, _, err = call("locate", "train", folder, tmp_path / "none" / "x.pt")
    assert code == 2 and "no folder" in err
