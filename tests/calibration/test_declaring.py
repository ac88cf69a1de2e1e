"""A device's samples as those of the array that it was built into, against numpy's own picking."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.calibration import CalibratedSource, Calibration, declare, declare_calibration
from tactile_rt.core.errors import SpecMismatch
from tactile_rt.core.stream import ArraySpec, Source
from tactile_rt.testing import ArraySource, cut_chunks, small_spec

CHANNELS = (("bx", "T"), ("by", "T"), ("bz", "T"), ("temperature", "K"), ("fx", "N"))
ROBOT = replace(
    small_spec(3),
    name="robot",
    elements=("left", "middle", "right"),
    grid=((1, 0), (0, 1), (1, 2)),
    positions=((0.01, 0.0, 0.0), (0.02, 0.0, 0.0), (0.03, 0.0, 0.01)),
    channels=("bx", "by"),
    units=("T", "T"),
    rate_hz=80.0,
    frame="plate",
)


def device(channels=CHANNELS[:4], elements: int = 3, **changes) -> ArraySpec:
    """What a codec says of three chips."""
    names, units = zip(*channels, strict=True)
    return replace(small_spec(elements), name="chip", channels=names, units=units, **changes)


def streamed(source: Source) -> tuple[np.ndarray, np.ndarray]:
    chunks = list(source)
    return tuple(np.concatenate([getattr(c, n) for c in chunks]) for n in ("values", "valid"))


@given(
    shown=st.permutations(CHANNELS),
    wanted=st.lists(st.sampled_from(CHANNELS), min_size=1, unique=True),
    seed=st.integers(0, 100),
)
def test_channels_are_picked_by_name_and_elements_taken_in_order(shown, wanted, seed) -> None:
    rng = np.random.default_rng(seed)
    spec = device(shown)
    names, units = zip(*wanted, strict=True)
    array = replace(ROBOT, channels=names, units=units)
    values = rng.normal(size=(20, *spec.shape)).astype(np.float32)
    source = declare(ArraySource(spec, cut_chunks(values, 1000.0)), array)
    assert source.spec == replace(array, rate_hz=spec.rate_hz)
    got, valid = streamed(source)
    assert np.array_equal(got, values[..., [shown.index(c) for c in wanted]])
    assert valid.all()


def test_what_is_not_asked_for_need_be_no_number() -> None:
    values = np.ones((5, 3, 4), np.float32)
    values[:, 1, 3] = np.nan  # the temperature
    values[2, 0, 1] = np.inf  # by
    got, valid = streamed(declare(ArraySource(device(), cut_chunks(values, 1000.0)), ROBOT))
    assert valid.sum() == valid.size - 1 and not valid[2, 0]
    assert (got[valid] == 1).all()


def test_elements_of_the_same_names_are_not_mixed_up() -> None:
    """A device that names its elements as the array does is believed, whatever the order."""
    array = replace(ROBOT, elements=("A2", "A0", "A1"))
    values = np.arange(3.0)[None, :, None] * np.ones((4, 3, 4))
    got, _ = streamed(declare(ArraySource(device(), cut_chunks(values, 1000.0)), array))
    assert (got[0, :, 0] == [2.0, 0.0, 1.0]).all()


def test_the_declaration_is_of_what_the_calibration_makes() -> None:
    """Counts of three gauges to two loads, mapped, tared, and then by the array's names."""
    rng = np.random.default_rng(3)
    raw = device((("s0", "1"), ("s1", "1"), ("s2", "1")))
    matrices = rng.normal(size=(3, 2, 3))
    tare = rng.normal(size=(3, 3))
    calibration = Calibration(
        "cell", raw.elements, raw.channels, raw.units,
        output_channels=("fx", "fy"), output_units=("N", "N"),
        matrices={e: tuple(map(tuple, m)) for e, m in zip(raw.elements, matrices, strict=True)},
        tare={e: tuple(t) for e, t in zip(raw.elements, tare, strict=True)},
        mapping={"a": "A2", "b": "A0"},
    )  # fmt: skip
    array = replace(small_spec(2), name="pads", channels=("fy",), units=("N",))
    values = rng.normal(size=(9, 3, 3))
    calibrated = CalibratedSource(ArraySource(raw, cut_chunks(values, 1000.0)), calibration)
    source = declare(calibrated, array)
    assert isinstance(source, CalibratedSource) and source.source is calibrated.source  # one alone
    got, _ = streamed(source)
    loads = np.einsum("eoc,nec->neo", matrices, values - tare)
    np.testing.assert_allclose(got[..., 0], loads[:, [2, 0], 1], rtol=1e-5, atol=1e-5)
    with pytest.raises(SpecMismatch, match=r"has s0 \(1\), cell gives fx \(N\), fy \(N\)"):
        declare(calibrated, replace(array, channels=("s0",), units=("1",)))


def test_a_source_that_is_of_the_array_is_left_alone() -> None:
    source = ArraySource(ROBOT, [])
    assert declare(source, replace(ROBOT, rate_hz=7.0)) is source


def test_the_last_declaration_counts() -> None:
    other = replace(ROBOT, name="other", elements=("x", "y", "z"))
    source = declare(declare(ArraySource(device(), []), ROBOT), other)
    assert source.spec.elements == ("x", "y", "z")
    assert isinstance(source.source, ArraySource)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (device(elements=2), "elements: the array 'robot' has 3 (left, middle, right), chip 2 (A0"),
        (device((("bx", "T"),)), "channels: the array 'robot' has by (T), chip gives bx (T): a"),
        (
            device((("bx", "T"), ("by", "uT"))),
            "channels: the array 'robot' has by (T), chip gives bx (T), by (uT): a calibration can",
        ),
        (device((("fx", "N"), ("fy", "N"))), "has bx (T), by (T), chip gives fx (N), fy (N)"),
    ],
)
def test_what_it_cannot_be_is_said_exactly(spec: ArraySpec, said: str) -> None:
    with pytest.raises(SpecMismatch) as caught:
        declare(ArraySource(spec, []), ROBOT)
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["AnySkin (5X)", "  ", "-", ".hidden", "päd", "a/b"])
def test_whatever_an_array_is_called_it_can_be_declared(name: str) -> None:
    spec = replace(device(), name=name)
    assert declare_calibration(spec, ROBOT).output_spec(spec).name == "robot"
