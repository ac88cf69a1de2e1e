"""Times of tables that go back: rows in another order, wrong stamps, midnight, another stretch."""

from random import Random

import numpy as np
import pytest

from tactile_rt.core.stream import concatenate
from tactile_rt.recording import Recording
from tactile_rt.recording.importing.table import import_table
from tactile_rt.recording.importing.table_form import csv_form, read_table

N = 100
EVEN = [k / 100 for k in range(N)]
SORTED, DATED, BACK = "lines stand in another order", "times do not fit", "times go back"


def imported(path, lines, columns="t=time:s,Fx=S.fx:N"):
    path.write_text("t,Fx\n" + "\n".join(lines) + "\n")
    made = import_table(read_table(path, csv_form(path)), path.with_suffix(".mcap"), columns)
    return made, concatenate(list(Recording(path.with_suffix(".mcap"))))


def rows(order):
    return [f"{k / 100:.3f},{k}" for k in order]


def swapped(*pairs):
    order = list(range(N))
    for i, j in pairs:
        order[i], order[j] = order[j], order[i]
    return order


@pytest.mark.parametrize(
    ("order", "moved"),
    [
        (swapped((83, 84)), 2), (swapped((0, 1)), 2), (swapped((98, 99)), 2),
        (swapped((40, 43)), 2), (swapped((10, 11), (12, 13)), 4),
        ([*range(20), *range(40, 60), *range(20, 40), *range(60, N)], 40),
        ([*range(30), 31, 32, 33, 34, 35, 30, *range(36, N)], 6),
    ],
)  # fmt: skip
def test_rows_that_changed_places_are_sorted(tmp_path, order, moved):
    made, chunk = imported(tmp_path / "t.csv", rows(order))
    assert (made.samples, made.rate_hz, made.seconds) == (N, 100, 0.99)
    assert chunk.values[:, 0, 0].tolist() == list(range(N))
    assert chunk.t_ns.tolist() == [10_000_000 * k for k in range(N)]
    assert made.notes == [f"{moved} {SORTED} than their times: sorted"]


@pytest.mark.parametrize("off", [-0.025, -0.0551, 0.033, -0.02])
@pytest.mark.parametrize("every", [10, 50])
def test_a_stamp_that_is_early_or_late_delays_none_after_it(tmp_path, off, every):
    times = [t + (off if k % every == 7 else 0) for k, t in enumerate(EVEN)]
    made, chunk = imported(tmp_path / "t.csv", [f"{t:.4f},{k}" for k, t in enumerate(times)])
    assert (made.samples, made.rate_hz, made.seconds) == (N, 100, 0.99)
    assert np.abs(chunk.t_ns / 1e7 - chunk.values[:, 0, 0]).max() < 1e-3
    assert len(made.notes) == 1 and made.notes[0].startswith(f"{N // every} {DATED}")


@pytest.mark.parametrize("wrong", [500.0, 0.0, 0.5, 60_000.0])
def test_one_stamp_that_is_far_off_is_left_out(tmp_path, wrong):
    lines = [f"{clock(t)},{k}" for k, t in enumerate([*EVEN[:20], wrong, *EVEN[21:]])]
    made, chunk = imported(tmp_path / "t.csv", lines, "t=time:iso,Fx=S.fx:N")
    assert chunk.t_ns.tolist() == [10_000_000 * k for k in range(N)]
    assert len(made.notes) == 1 and DATED in made.notes[0]


@pytest.mark.parametrize(
    ("times", "stretches"),
    [
        (EVEN[:50] + EVEN[:50], 1), (EVEN[:10] * 10, 9),
        (EVEN[:50] + [t - 0.05 for t in EVEN[50:]], 1),  # the host's clock was set
    ],
)  # fmt: skip
def test_only_a_jump_back_that_lasts_begins_another_stretch(tmp_path, times, stretches):
    made, chunk = imported(tmp_path / "t.csv", [f"{t:.4f},{k}" for k, t in enumerate(times)])
    assert chunk.t_ns.tolist() == [10_000_000 * k for k in range(N)]
    assert made.notes == [f"{BACK} {stretches} times: there they go on a period later"]


def test_times_that_are_not_even_lose_none_of_their_length(tmp_path):
    draw = Random(3)
    times = np.cumsum([draw.expovariate(100) for _ in range(300)]).round(6).tolist()
    for at in (50, 120, 200):
        times[at], times[at + 1] = times[at + 1], times[at]
    made, chunk = imported(tmp_path / "t.csv", [f"{t:.6f},{k}" for k, t in enumerate(times)])
    assert made.samples == 300 and (np.diff(chunk.t_ns) > 0).all()
    assert made.seconds == pytest.approx(times[-1] - times[0], abs=1e-6)
    assert not any(BACK in note for note in made.notes)


def test_a_file_with_its_newest_line_first_is_read_from_its_end(tmp_path):
    made, chunk = imported(tmp_path / "t.csv", rows(range(N))[::-1])
    assert chunk.values[:, 0, 0].tolist() == list(range(N)) and "its newest" in made.notes[0]


def clock(seconds, pattern="{:02}:{:02}:{:06.3f}"):
    return pattern.format(int(seconds) // 3600 % 24, int(seconds) // 60 % 60, seconds % 60)


@pytest.mark.parametrize("pattern", ["{:02}:{:02}:{:06.3f}", "{}:{}:{:.2f}"])
@pytest.mark.parametrize("gap", [0, 30])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_time_of_day_goes_on_after_midnight(tmp_path, pattern, gap, mixed):
    times = [86_390 + k / 4 + gap * (k > 50) for k in range(N)]
    lines = [f"{clock(t, pattern)},{k}" for k, t in enumerate(times)]
    if mixed:
        lines[39], lines[40] = lines[40], lines[39]
    made, chunk = imported(tmp_path / "t.csv", lines, "t=time:iso,Fx=S.fx:N")
    assert (chunk.t_ns - chunk.t_ns[0]).tolist() == [round(1e9 * (t - times[0])) for t in times]
    assert len(made.notes) == mixed + (gap > 0) and made.rate_hz == 4
    table = read_table(tmp_path / "t.csv", csv_form(tmp_path / "t.csv"))
    told = import_table(table, tmp_path / "o.mcap", "t=time:iso,Fx=S.fx", 1000).notes[-1]
    assert told == "its times tell 4 Hz, not the 1000 Hz of --rate"
