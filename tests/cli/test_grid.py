"""`tactile-rt grid` refuses what it cannot do in one line."""

import pytest

for module in ("torch", "lightning", "matplotlib"):
    pytest.importorskip(module)


def test_a_damaged_grid_makes_nothing(refused, tmp_path):
    plan = tmp_path / "grid.toml"
    plan.write_text('data = "x"\n[[cell]]\nencoder = "gru"\nattender = "gptt"\n')
    assert "attender is 'gptt', not one of" in refused("grid", plan, tmp_path / "out")
    plan.write_bytes(b"\xff\xfe")
    assert "grid.toml:1: not UTF-8 text" in refused("grid", plan, tmp_path / "out")
    assert not (tmp_path / "out").exists()
