from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core import stream
from tactile_rt.core.errors import ConfigError, TactileError
from tactile_rt.core.stream import ArraySpec, Chunk, EndOfStream, Source, Timing, concatenate
from tactile_rt.testing import ArraySource, cut_chunks, small_spec

SPEC = small_spec()

names = st.text(min_size=1, max_size=8)
metres = st.floats(-10, 10)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4)


@st.composite
def specs(draw: st.DrawFn) -> ArraySpec:
    n = draw(st.integers(1, 5))
    channels = draw(st.lists(names, min_size=1, max_size=4, unique=True))

    def each(strategy, **more):
        return tuple(draw(st.lists(strategy, min_size=n, max_size=n, **more)))

    return ArraySpec(
        name=draw(st.text()),
        elements=each(names, unique=True),
        grid=each(st.tuples(st.integers(0, 40), st.integers(0, 40)), unique=True),
        positions=each(st.tuples(metres, metres, metres)),
        orientations=each(quaternions),
        channels=tuple(channels),
        units=tuple(draw(names) for _ in channels),
        rate_hz=draw(st.floats(1e-3, 1e6)),
        frame=draw(st.text()),
    )


@given(specs())
def test_a_spec_survives_json_bit_for_bit(spec: ArraySpec) -> None:
    text = spec.to_json()
    again = ArraySpec.from_json(text)
    assert again == spec
    assert hash(again) == hash(spec)
    assert again.differences(spec) == []
    assert again.to_json() == text
    assert "\n" not in text


@given(specs())
def test_the_grid_shape_holds_every_element_and_no_empty_border(spec: ArraySpec) -> None:
    cells = np.zeros(spec.grid_shape, dtype=int)
    for row, column in spec.grid:
        cells[row, column] += 1
    assert cells.sum() == cells.max(initial=0) * len(spec.elements) == len(spec.elements)
    assert cells[-1].any() and cells[:, -1].any()


def with_item(items: tuple, at: int, item: object) -> tuple:
    return (*items[:at], item, *items[at + 1 :])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "other"}, "name is 'other', not 'small'"),
        ({"rate_hz": 500.0}, "rate_hz is 500.0, not 1000.0"),
        ({"elements": with_item(SPEC.elements, 2, "B2")}, "elements[2] is 'B2', not 'A2'"),
        ({"grid": with_item(SPEC.grid, 1, (4, 1))}, "grid[1] is (4, 1), not (0, 1)"),
        ({"channels": ("fy", "fx")}, "channels[1] is 'fx', not 'mz'"),
        (
            {"positions": with_item(SPEC.positions, 1, (0.0, 0.003, 0.0))},
            "positions[1] is (0.0, 0.003, 0.0), not (0.0, 0.002, 0.0)",
        ),
        (
            {"channels": (*SPEC.channels, "fx"), "units": (*SPEC.units, "N")},
            "channels are (fy, mz, fx), not (fy, mz)",
        ),
        (
            {n: getattr(SPEC, n)[1:] for n in ("elements", "grid", "positions", "orientations")},
            "elements: 2 entries, not 3; grid: 2 entries, not 3",
        ),
        ({"name": "other", "frame": "base"}, "name is 'other', not 'small'; frame is"),
    ],
)
def test_differences_name_the_exact_place(change: dict, said: str) -> None:
    assert "; ".join(SPEC.differences(replace(SPEC, **change))).startswith(said)


def test_differences_can_be_ignored_by_name() -> None:
    other = replace(SPEC, name="other", rate_hz=500.0, frame="base")
    assert SPEC.differences(other, ignore=("name", "rate_hz")) == ["frame is 'base', not 'mount'"]


def test_a_pose_may_be_off_by_less_than_anyone_can_measure() -> None:
    for off, same in ((1.5e-6, False), (1e-7, True)):
        near = tuple((x + off, y, z) for x, y, z in SPEC.positions)
        assert (SPEC.differences(replace(SPEC, positions=near)) == []) == same
    # and such a harmless difference must not be blamed for a real one further on
    far = with_item(near, 2, (0.001, 0.004, 0.0))
    (said,) = SPEC.differences(replace(SPEC, positions=far))
    assert said.startswith("positions[2] is (0.001,")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"grid": SPEC.grid[:2]}, "array 'small': grid has 2 entries for 3 elements"),
        ({"positions": SPEC.positions[:1]}, "positions has 1 entries for 3 elements"),
        ({"orientations": ()}, "orientations has 0 entries for 3 elements"),
        (
            {"elements": (), "grid": (), "positions": (), "orientations": ()},
            "needs at least one element",
        ),
        ({"channels": (), "units": ()}, "at least one element and one channel"),
        ({"units": ("N",)}, "1 units for 2 channels"),
        ({"elements": ("A0", "A1", "A0")}, "elements repeat"),
        ({"channels": ("fx", "fx")}, "channels repeat"),
        ({"grid": ((0, 0), (0, 1), (0, 0))}, "grid repeat"),
        ({"grid": ((0, 0), (0, 1), (-1, 0))}, "counted from 0"),
        ({"rate_hz": 0.0}, "rate_hz must be positive, not 0.0"),
        ({"rate_hz": float("nan")}, "rate_hz must be positive"),
        ({"rate_hz": float("inf")}, "rate_hz must be positive"),
        # JSON has no infinity: such a spec could be written and never be read again
        ({"positions": ((float("inf"), 0.0, 0.0),) * 3}, "positions must be finite"),
        ({"orientations": ((float("nan"), 0.0, 0.0, 0.0),) * 3}, "orientations must be finite"),
    ],
)
def test_an_impossible_spec_is_refused(change: dict, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        replace(SPEC, **change)


def edited(**fields: object) -> str:
    return msgspec.json.encode({**msgspec.json.decode(SPEC.to_json()), **fields}).decode()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "not an array spec"),
        ("{", "not an array spec"),
        ("[]", "not an array spec"),
        ("{}", "version None; this release reads 1"),
        (edited(version=2), "version 2; this release reads 1"),
        (edited(version="1"), "version '1'; this release reads 1"),
        (
            edited(rate_hz="fast"),
            r"not an array spec: Expected `float`, got `str` - at `\$.rate_hz",
        ),
        (edited(grid=[[0, 0], [0, 1], [0]]), r"at `\$.grid\[2\]`"),
        ('{"version": 1, "name": "x"}', "missing required field `elements`"),
        (edited(rate_hz=-1), "rate_hz must be positive"),
    ],
)
def test_json_that_is_no_spec_of_this_version_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        ArraySpec.from_json(text)


def chunk(n: int = 4, **parts: np.ndarray) -> Chunk:
    fields = {"seq": np.arange(n), "t_ns": np.arange(n), "valid": np.ones((n, 3), dtype=bool)}
    return Chunk(**{**fields, "values": np.zeros((n, 3, 2), dtype=np.float32), **parts})


@pytest.mark.parametrize(
    "parts",
    [
        {"n": 0},
        {"t_ns": np.arange(3)},
        {"seq": np.arange(5)},
        {"values": np.zeros((4, 3), dtype=np.float32)},
        {"values": np.zeros((5, 3, 2), dtype=np.float32)},
        {"valid": np.ones((4, 2), dtype=bool)},
        {"valid": np.ones(4, dtype=bool)},
    ],
)
def test_a_chunk_whose_parts_disagree_is_refused(parts: dict) -> None:
    with pytest.raises(ValueError, match=r"chunk of \d samples with t_ns"):
        chunk(**parts)


def test_concatenated_chunks_are_the_stream_and_a_copy_of_it() -> None:
    values = np.random.default_rng(0).normal(size=(20, *SPEC.shape)).astype(np.float32)
    pieces = cut_chunks(values, SPEC.rate_hz, samples=3)
    whole = concatenate(pieces)
    assert len(whole) == 20
    assert np.array_equal(whole.values, values)
    assert np.array_equal(whole.seq, np.arange(20))
    assert np.array_equal(whole.t_ns, np.arange(20) * 1_000_000)
    pieces[0].values[:] = 7
    assert not (whole.values[:3] == 7).any()
    with pytest.raises(ValueError):
        concatenate([])


def test_every_error_a_caller_may_handle_is_a_tactile_error() -> None:
    from tactile_rt.core import stream

    errors = [c for c in vars(stream).values() if isinstance(c, type) and issubclass(c, Exception)]
    # The end of a stream is no error: a caller who handles errors must not swallow it.
    assert {c for c in errors if not issubclass(c, TactileError)} == {EndOfStream}


def test_an_array_source_refuses_chunks_of_another_shape() -> None:
    with pytest.raises(ValueError, match=r"chunk of shape \(9, 4, 2\)"):
        ArraySource(SPEC, cut_chunks(np.zeros((9, 4, 2)), 1000.0))


class Given(Source):
    """Gives out what it is given, then ends."""

    def __init__(self, *given: Chunk | None) -> None:
        self.spec, self._given, self.closed = SPEC, list(given), False

    def read(self, timeout: float | None = None) -> Chunk | None:
        if not self._given:
            raise EndOfStream
        return self._given.pop(0)

    def close(self) -> None:
        self.closed = True


def test_what_does_not_come_in_time_is_no_chunk_of_a_stream() -> None:
    first, second = cut_chunks(np.zeros((4, *SPEC.shape), dtype=np.float32), 1000.0, samples=2)
    assert list(Given(None, first, None, None, second)) == [first, second]


def test_a_source_is_closed_where_its_context_is_left() -> None:
    with Given() as source:
        assert source.live and source.fileno() == -1 and not source.closed
    assert source.closed


def test_quaternions_turn_as_those_of_scipy_do() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    p, q = (rotation.random(9, random_state=seed) for seed in (1, 2))
    as_ours = [turn.as_quat()[:, [3, 0, 1, 2]] for turn in (p, q)]
    assert stream.rotation_matrices(7 * as_ours[0]) == pytest.approx(p.as_matrix(), abs=1e-12)
    products = np.array([stream.quaternion_product(*pair) for pair in zip(*as_ours, strict=True)])
    assert stream.rotation_matrices(products) == pytest.approx((p * q).as_matrix(), abs=1e-12)


def test_a_step_is_as_near_to_45_ms_as_samples_are() -> None:
    assert [Timing.of(ns).substeps for ns in (9_000_000, 20_000_000, 90_000_000)] == [5, 2, 1]
    assert Timing() == stream.MOUSE and (stream.MOUSE.substeps, stream.MOUSE.samples) == (5, 110)


def test_an_array_of_unknown_geometry_lies_at_its_frame_s_origin():
    one = ArraySpec.at_origin("a", 100.0, {"fx": "N"})
    assert (one.elements, one.grid, one.frame) == (("sensor",), ((0, 0),), "sensor")
    two = ArraySpec.at_origin("a", 100.0, {"fx": "N"}, elements={"L": (0, 1), "R": (2, 3)})
    assert two.positions == ((0.0, 0.0, 0.0),) * 2 and two.grid == ((0, 1), (2, 3))
    assert two.orientations == ((1.0, 0.0, 0.0, 0.0),) * 2
    assert not any(vars(stream.SourceStats()).values()), "nothing is counted at first"
