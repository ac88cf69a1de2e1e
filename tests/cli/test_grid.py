"""`tactile-rt grid` refuses what it cannot do in one line."""

import pytest

for module in ("torch", "lightning", "matplotlib"):
    pytest.importorskip(module)


def test_no_such_grid(refused, tmp_path):
    assert "no grid none: name a TOML file, or one of wide24" in refused("grid", "none", tmp_path)


def test_a_damaged_grid_makes_nothing(refused, tmp_path):
    plan = tmp_path / "grid.toml"
    plan.write_text('data = "x"\n[[cell]]\nencoder = "gru"\nattender = "gptt"\n')
    assert "attender is 'gptt', not one of" in refused("grid", plan, tmp_path / "out")
    plan.write_bytes(b"\xff\xfe")
    assert "grid.toml:1: not UTF-8 text" in refused("grid", plan, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_set_that_is_not_there(refused, tmp_path):
    plan = tmp_path / "grid.toml"
    plan.write_text(f'data = "{tmp_path}/none"\n[[cell]]\nencoder = "gru"\n')
    assert "is not a sweep set" in refused("grid", plan, tmp_path / "out")
