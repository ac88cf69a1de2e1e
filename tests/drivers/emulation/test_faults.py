"""Fault schedules: read, checked, repeatable, one fault a sample."""

from collections import Counter
from pathlib import Path

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.emulation.faults import (
    Fate,
    Fault,
    FaultSchedule,
    damage_packet,
    read_faults,
)

RATE = 1000


def hits(schedule: FaultSchedule, seconds: float, end: float | None = None) -> dict[int, Fault]:
    """{sample: what hits it} of so many seconds at 1 kHz."""
    found = {}
    for n in range(round(seconds * RATE)):
        t = n / RATE
        fault = schedule.at(t, end is not None and t > end - 0.5)
        if fault is not None:
            found[n] = fault
    return found


def test_a_schedule_is_read(tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(
        'seed = 7\n[[fault]]\nkind = "bit_flip"\nrate = 2\namount = 3\n'
        '[[fault]]\nkind = "unplug"\nat_s = 5.0\nduration_s = 0.5\n'
    )
    schedule = read_faults(file)
    flip, unplug = Fault("bit_flip", rate=2.0, amount=3), Fault("unplug", at_s=5.0, duration_s=0.5)
    assert schedule.faults == (flip, unplug)
    again = hits(FaultSchedule(schedule.faults, 7), 30)
    assert hits(schedule, 30) == again
    assert hits(FaultSchedule(schedule.faults, 8), 30) != again


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'kind = "bitflip"\nrate = 1',
            "faults.toml:1: fault[0]: no fault kind 'bitflip'; did you mean bit_flip?",
        ),
        ('kind = "drop"\nrat = 1', ":3: fault[0] has no key 'rat'; did you mean rate?"),
        ('kind = "drop"', "give either rate (faults per second) or at_s"),
        ('kind = "drop"\nrate = -1', "rate must be 0 or more, not -1"),
        ('kind = "drop"\nat_s = 0.2', "at_s must be 0.5 or more"),
        ('kind = "drop"\nat_s = 2\nduration_s = 1', "drop takes no duration_s"),
        ('kind = "stall"\nat_s = 2', "duration_s must be more than 0 for stall"),
        ('kind = "stall"\nat_s = 2\nduration_s = 1\namount = 2', "stall takes no amount"),
        ('kind = "truncate"\nat_s = 2\namount = 0', "amount must be a whole number of bytes"),
        ("rate = 1", "fault[0]: needs a key 'kind'"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_and_key(tmp_path, text, message):
    file = tmp_path / "faults.toml"
    file.write_text(f"[[fault]]\n{text}\n")
    with pytest.raises(ConfigError) as caught:
        read_faults(file)
    assert str(caught.value).startswith(str(file))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_so_is_a_file_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[[faults]]\n")
    with pytest.raises(ConfigError, match="the file has no key 'faults'; did you mean fault"):
        read_faults(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text("seed = 1\n")
    with pytest.raises(ConfigError, match="give at least one"):
        read_faults(tmp_path / "b.toml")


def test_rates_are_kept_and_the_ends_are_quiet() -> None:
    faults = [Fault("bit_flip", rate=5), Fault("truncate", rate=3), Fault("duplicate", rate=1)]
    found = hits(FaultSchedule(faults, 1), 200, end=200)
    assert min(found) >= 500 and max(found) <= 199_500
    counts = Counter(f.kind for f in found.values())
    for fault in faults:
        expected = fault.rate * 199
        assert abs(counts[fault.kind] - expected) < 4 * expected**0.5


def test_faults_at_one_time_come_one_after_the_other() -> None:
    kinds = ["bit_flip", "truncate", "duplicate", "burst", "clock_jump"]
    found = hits(FaultSchedule([Fault(k, at_s=1.0) for k in kinds]), 2)
    assert sorted(found) == [1000, 1001, 1002, 1003, 1004]
    assert sorted(f.kind for f in found.values()) == sorted(kinds)


def test_what_lasts_hits_each_sample_and_nothing_else_does() -> None:
    faults = [
        Fault("drop", at_s=1.0, amount=7),
        Fault("stall", at_s=1.5, duration_s=0.1),
        Fault("bit_flip", at_s=1.55),
        Fault("unplug", at_s=2.0, duration_s=0.25),
        Fault("clock_drift", at_s=3.0, duration_s=5.0),
    ]
    found = hits(FaultSchedule(faults), 4)
    by_kind: dict[str, list[int]] = {}
    for n, fault in found.items():
        by_kind.setdefault(fault.kind, []).append(n)
    assert by_kind == {
        "drop": list(range(1000, 1007)),
        "stall": list(range(1500, 1600)),
        "bit_flip": [1600],
        "unplug": list(range(2000, 2250)),
        "clock_drift": [3000],
    }


def test_nothing_is_lost_beside_a_restart() -> None:
    faults = [Fault("drop", rate=200, amount=3), Fault("sequence_reset", rate=1)]
    found = hits(FaultSchedule(faults, 3), 20)
    resets = [n for n, f in found.items() if f.kind == "sequence_reset"]
    drops = [n for n, f in found.items() if f.kind == "drop"]
    assert len(resets) > 8 and len(drops) > 1000
    assert min(abs(d - r) for d in drops for r in resets) >= 50


def test_what_damage_does_to_a_packet() -> None:
    draw = FaultSchedule([]).random
    packet = bytes(range(40))
    for bits in (1, 5, 9999):
        hurt, fate = damage_packet(packet, Fault("bit_flip", rate=1, amount=bits), draw)
        assert fate == Fate.CORRUPTED and len(hurt) == 40
        flipped = sum((a ^ b).bit_count() for a, b in zip(packet, hurt, strict=True))
        assert flipped == min(bits, 320)
    cut = damage_packet(packet, Fault("truncate", rate=1, amount=4), draw)
    assert cut == (packet[:36], Fate.TRUNCATED)
    assert damage_packet(packet, Fault("truncate", rate=1, amount=99), draw)[0] == packet[:1]
    frames = [CanFrame(i) for i in range(9)]
    left, fate = damage_packet(frames, Fault("bit_flip", rate=1, amount=2), draw)
    assert fate == Fate.CORRUPTED and len(left) == 7
    assert [f for f in frames if f in left] == left
    assert damage_packet(frames, Fault("truncate", rate=1, amount=9), draw)[0] == []
