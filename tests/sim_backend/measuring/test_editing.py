"""An array's file with other numbers: everything else stays."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.sim_backend.measuring.findings import Edit
from tactile_rt.sim_backend.measuring.fitting import edit_text
from tests.helpers.refusals import refusal

FILE = Path("some.toml")
TEXT = """\
# A file.  noise_density = 7
name = "some"   # [defaults]

[sensor]
rate_hz = 100
matrix = { A0 = [
  [1.0],  # a row
  [drift],
] }

[[sensor.channel]]
name = "my"
  noise_density   =  2e-9      # N m per root of a hertz

# of the second
[[sensor.channel]]
name = "mz"
of = { mz = 1.5, my = 0.1 } # linear

[defaults]
damping_ratio = 0.05
""".replace("  [drift],\n", "  [2.0],\n")
DRIFT = ("sensor", "channel", 1, "drift")


def test_a_value_changes_and_nothing_else() -> None:
    path = ("sensor", "channel", 0, "noise_density")
    after = edit_text(FILE, TEXT, [Edit(path, 3.5e-9, "3.5e-9 +- 5 %")])
    changed = "  noise_density   =  3.5e-09      # N m per root of a hertz; measured: 3.5e-9 +- 5 %"
    was = "  noise_density   =  2e-9      # N m per root of a hertz"
    assert after == TEXT.replace(was, changed)


def test_a_new_value_comes_after_the_last_of_its_table() -> None:
    after = edit_text(FILE, TEXT, [Edit(DRIFT, 1e-8, "so")])
    assert "my = 0.1 } # linear\ndrift = 1e-08 # measured: so\n\n[defaults]" in after


def test_a_table_that_is_not_there_is_added() -> None:
    text = TEXT.removesuffix("[defaults]\ndamping_ratio = 0.05\n")
    after = edit_text(FILE, text, [Edit(("defaults", "friction"), 0.25, "so")])
    assert after == f"{text}\n[defaults]\nfriction = 0.25 # measured: so\n"


def test_lines_end_as_they_did() -> None:
    after = edit_text(FILE, TEXT.replace("\n", "\r\n"), [Edit(DRIFT, 1e-8, "so")])
    assert after == edit_text(FILE, TEXT, [Edit(DRIFT, 1e-8, "so")]).replace("\n", "\r\n")


@given(
    value=st.floats(1e-15, 1e15).map(lambda v: float(f"{v:.4g}")),
    path=st.sampled_from(
        [
            DRIFT,
            ("sensor", "rate_hz"),
            ("sensor", "magnet", "moment_a_m2"),
            ("sensor", "channel", 0, "noise_density"),
            ("defaults", "damping_ratio"),
            ("defaults", "friction"),
        ]
    ),
)
def test_the_file_reads_as_before_but_for_the_value(value, path) -> None:
    after, before = (
        tomllib.loads(edit_text(FILE, TEXT, [Edit(path, value, "x")])),
        tomllib.loads(TEXT),
    )
    at = after
    for part in path[:-1]:
        at = at[part]
    assert at[path[-1]] == value
    kept = {key: v for key, v in after["sensor"].items() if key not in ("channel", "magnet")}
    if path != ("sensor", "rate_hz"):
        assert kept == {"rate_hz": 100, "matrix": {"A0": [[1.0], [2.0]]}}
    assert after["name"] == before["name"]


@pytest.mark.parametrize("text", ["sensor = { rate_hz = 100 }\n", "sensor.rate_hz = 100\n"])
def test_what_cannot_be_changed_is_said_in_a_line(text: str) -> None:
    said = refusal(edit_text, FILE, text, [Edit(("sensor", "rate_hz"), 80.0, "so")])
    assert said == (
        "some.toml: cannot change rate_hz as it is written there; put rate_hz = 80 into its "
        "table by hand"
    )
