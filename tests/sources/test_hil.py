"""Hardware in the loop: the comparison can fail, and does not where it must not."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classification
from tactile_rt.core.errors import ConfigError, SourceError, SpecMismatch
from tactile_rt.core.stream import SourceStats
from tactile_rt.drivers.codecs.native import NativeSerial
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.drivers.health import Health, State
from tactile_rt.sources.hil import Loop, LoopReport, named_right, pair
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.tiny_model import write_model

SPEC = small_spec()
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model") / "tiny.onnx")


def touches(n: int = 3000, start_ns: int = 12_345_678, **source) -> ArraySource:
    """Two touches; times begin anywhere, and not at a whole microsecond."""
    values = np.random.default_rng(0).normal(size=(n, *SPEC.shape)) * 2e-3
    values[1600:1900, 0] += 0.05
    values[2400:2700, 1] += 0.08
    return ArraySource(SPEC, cut_chunks(values, SPEC.rate_hz, 9, start_ns), **source)


@pytest.mark.parametrize("wire", ["serial", "slcan", "virtual"])
def test_float32_is_bit_equal_over_every_wire(model: Path, wire: str) -> None:
    report = Loop(touches(), model, wire, options={"format": "float32"}).run()
    assert report.failure == "" and report.exact and not report.faulty
    assert report.identical_samples == report.samples == report.stats.delivered == 3000
    assert report.identical == report.same_label == report.direct == report.wire == 8
    assert report.finals == report.finals_same == 2


def test_a_codec_with_names_of_its_own_carries_any_array_that_fits(model: Path) -> None:
    """A line of numbers, with the time and what nobody asked for, whose elements are W0, W1, W2."""
    measured = [f"W{e}.{c}" for e in range(3) for c in ("temperature:degC", "mz:N m", "fy:N")]
    options = {"columns": ",".join(["count", "time:us", *measured])}
    report = Loop(touches(), model, codec="ascii_line", options=options).run()
    assert report.failure == "" and report.identical_samples == 3000
    assert report.direct == report.wire == report.same_label == 8


def test_a_device_that_sends_no_time_is_compared_as_if_samples_were_a_period_apart(model):
    columns = ",".join(f"W{e}.{c}" for e in range(3) for c in ("fy:N", "mz:N m"))
    report = Loop(touches(), model, codec="ascii_line", options={"columns": columns}).run()
    assert report.failure == "" and report.identical_samples == 3000
    assert report.direct == report.wire == report.same_label == 8


def test_what_a_codec_cannot_carry_is_refused(model: Path) -> None:
    with pytest.raises(SpecMismatch, match=r"the array 'small' has 3 \(A0, A1, A2\), bota 1"):
        Loop(touches(), model, codec="bota").run()


def test_what_a_format_rounds_is_not_bit_equal_and_need_not_be(model: Path) -> None:
    report = Loop(touches(), model, options={"format": "int16", "range_n": "0.2"}).run()
    assert not report.exact and report.direct == report.wire == 8
    assert report.identical_samples < 100 and report.identical < 8


@pytest.mark.parametrize("by", [None, 1e-3])
def test_a_driver_that_alters_one_value_is_found_out(model, monkeypatch, by):
    """In one sample of a touch: by one unit in the last place, or so that decisions differ."""
    honest, seen = NativeSerial.feed, []

    def lying(self, packet, t_ns):
        samples = honest(self, packet, t_ns)
        if samples is not None:
            seen.append(len(samples))
            at = 1650 - (sum(seen) - len(samples))
            if 0 <= at < len(samples):
                one = samples.values[at, 0, 0]
                samples.values[at, 0, 0] = one + by if by else np.nextafter(one, np.float32(1))
        return samples

    monkeypatch.setattr(NativeSerial, "feed", lying)
    report = Loop(touches(), model).run()
    assert report.identical_samples == 2999
    assert report.direct == report.wire == 8 and (report.identical < 8) == bool(by)
    assert report.failure == "the driver's path is not bit-equal to the direct one"


def test_losses_are_accounted_for(model: Path) -> None:
    faults = FaultSchedule((Fault("drop", at_s=1.0, amount=7), Fault("bit_flip", at_s=1.2)), 1)
    report = Loop(touches(), model, faults=faults).run()
    assert report.faulty and not report.exact and report.accounted and report.failure == ""
    assert report.stats == SourceStats(delivered=2992, corrupt=1, missing=7)
    assert report.samples == 3000 and report.identical_samples == 2992


def test_a_source_that_breaks_is_told(model: Path) -> None:
    class Broken(ArraySource):
        def read(self, timeout=None):
            if len(self._left) < 100:
                raise SourceError("the finger is off")
            return super().read(timeout)

    with pytest.raises(SourceError, match="the finger is off"):
        Loop(Broken(SPEC, cut_chunks(np.zeros((3000, *SPEC.shape)), SPEC.rate_hz)), model).run()


@pytest.mark.parametrize(
    ("further", "said"),
    [
        ({"wire": "usb"}, "wire must be one of serial, slcan, virtual, not 'usb'"),
        ({"codec": "nativ"}, "no serial codec 'nativ'"),
        ({"options": {"range_n": "0"}}, "range_n, range_nm and range_si must be above 0"),
    ],
)
def test_what_cannot_be_is_refused(model: Path, further: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Loop(touches(), model, **further)


def decision(onset: int, step: int, label: str = "a", final: bool = False) -> Classification:
    shares = np.array([0.6, 0.4], np.float32)
    return Classification(onset, onset + step, step, final, label, ("a", "b"), shares, 0.0)


def test_decisions_are_paired_by_touch_and_step() -> None:
    ms = 1_000_000
    direct = [decision(0, 1), decision(0, 2), decision(500 * ms, 1), decision(900 * ms, 1)]
    wire = [decision(9 * ms, 1), decision(500 * ms, 1), decision(500 * ms, 2)]
    assert pair(direct, wire) == [(direct[0], wire[0]), (direct[2], wire[1])]


def test_an_object_is_named_by_the_last_decision_of_its_first_touch() -> None:
    passes = [(0, "a"), (100, "b"), (200, "b"), (300, "a")]
    named = [
        decision(10, 1, "b"), decision(10, 2, "a", final=True), decision(50, 1, "b", final=True),
        decision(150, 1, "a", final=True), decision(160, 1, "b", final=True),
        decision(210, 1, "b", final=True), decision(310, 1, "a"),
    ]  # fmt: skip
    assert named_right(passes, named) == 2
    assert named_right([], named) == 0


GOOD = LoopReport(
    samples=1000, identical_samples=1000, direct=100, wire=100, identical=100, same_label=100,
    finals=5, finals_same=5, passed=0, right=0, exact=True, faulty=False,
    stats=SourceStats(delivered=1000), sent=1000, health=Health(State.STREAMING, 0),
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"identical": 99}, "not bit-equal"),
        ({"identical_samples": 999}, "not bit-equal"),
        ({"wire": 101}, "not bit-equal"),
        ({"identical": 0, "identical_samples": 0, "exact": False, "same_label": 99}, ""),
        ({"exact": False, "same_label": 98}, "less than 99%"),
        ({"exact": False, "same_label": 99, "wire": 101}, "less than 99%"),
        ({"direct": 0, "wire": 0, "identical": 0, "same_label": 0}, "nothing was touched"),
        ({"sent": 1001}, "does not add up"),
        ({"sent": 1001, "faulty": True, "exact": False}, "does not add up"),
        ({"faulty": True, "exact": False, "same_label": 0}, ""),
        ({"sent": 1003, "stats": SourceStats(1000, 1, 1, 0, 1), "faulty": True}, ""),
    ],
)
def test_the_verdict(changes: dict, said: str) -> None:
    failure = dataclasses.replace(GOOD, **changes).failure
    assert said in failure and bool(said) == bool(failure)
