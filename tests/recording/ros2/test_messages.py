"""Messages as ROS 2 has them: other people's encoders and definitions say whether they are."""

import math
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.ros2 import cdr, messages
from tactile_rt.recording.ros2.cdr import PACKAGE, SIMPLE, STANDARD, fields_of, schema_text
from tactile_rt.testing import cut_chunks, small_spec

OURS = sorted(f"tactile_rt_msgs/msg/{p.stem}" for p in (PACKAGE / "msg").glob("*.msg"))
RANGES = {
    "bool": st.booleans(), "uint8": st.integers(0, 255),
    "int32": st.integers(-(2**31), 2**31 - 1), "uint32": st.integers(0, 2**32 - 1),
    "int64": st.integers(-(2**63), 2**63 - 1), "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    # A string ends at its zero.
    "string": st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]),
                      max_size=9),
}  # fmt: skip


def any_of(message):
    """Whatever a message may hold."""
    kinds = {}
    for name, kind, many in fields_of(message):
        one = RANGES[kind] if kind in SIMPLE else any_of(kind)
        kinds[name] = st.lists(one, max_size=4) if many else one
    return st.fixed_dictionaries(kinds)


@pytest.fixture(scope="module")
def store():
    """Rosbags' own types, and ours as it reads them from the text that a recording has."""
    made = get_typestore(Stores.ROS2_HUMBLE)
    for name in OURS:
        made.register({k: v for k, v in get_types_from_msg(schema_text(name), name).items()
                       if k not in made.fielddefs})  # fmt: skip
    return made


def theirs(store, message, values):
    """An object of rosbags."""
    made = {}
    for name, kind, many in fields_of(message):
        one = values[name]
        if kind not in SIMPLE:
            one = [theirs(store, kind, v) for v in one] if many else theirs(store, kind, one)
        elif many and kind != "string":
            one = np.array(one, kind)
        made[name] = one
    return store.types[message](**made)


@pytest.mark.parametrize("message", [*OURS, messages.WRENCH])
def test_bytes_are_those_of_another_encoder_and_come_back(message, store):
    @given(values=any_of(message))
    def check(values):
        data = cdr.encode(message, values)
        expected = bytes(store.serialize_cdr(theirs(store, message, values), message))
        # Rosbags fills the end up to a multiple of 4.
        assert expected[: len(data)] == data and not any(expected[len(data) :])
        assert cdr.decode(message, data) == values

    check()


@given(data=st.binary(max_size=90), keep=st.integers(0, 120))
def test_what_is_no_message_is_refused_or_reads_as_one(data, keep):
    whole = messages.event_message(b'{"type":"contact","source":"a"}')
    for made in (whole[:keep] + data, cdr.CDR + data):
        try:
            values = cdr.decode(messages.EVENT, made)
        except ValueError:
            continue
        assert len(cdr.encode(messages.EVENT, values)) == len(made)


def test_what_is_of_other_packages_is_as_ros_2_has_it(store):
    for name in STANDARD:
        own = get_types_from_msg(schema_text(name), name)[name]
        assert own == store.fielddefs[name], name


def test_the_package_builds_all_messages_and_depends_on_what_they_need():
    cmake, about = ((PACKAGE / n).read_text("utf-8") for n in ("CMakeLists.txt", "package.xml"))
    assert sorted(re.findall(r'"msg/(\w+)\.msg"', cmake)) == [n.rpartition("/")[2] for n in OURS]
    kinds = {kind for m in (*OURS, *STANDARD) for _, kind, _ in fields_of(m)} - {*SIMPLE}
    needed = {kind.partition("/")[0] for kind in kinds} - {"tactile_rt_msgs"}
    assert needed <= set(re.findall(r"<depend>(\w+)</depend>", about))
    assert needed <= set(re.findall(r"find_package\((\w+) REQUIRED\)", cmake))
    assert "<name>tactile_rt_msgs</name>" in about and "project(tactile_rt_msgs)" in cmake


def test_names_are_those_of_ros_2():
    assert cdr.dds_type(messages.WRENCH) == "geometry_msgs::msg::dds_::WrenchStamped_"
    found = [cdr.token(t) for t in ("left", "fleet-7", "9", "", "M\u00fcg 1")]
    assert found == ["left", "fleet_7", "_9", "_", "M_g_1"]
    for name in OURS:  # fields that rosidl takes
        assert all(re.fullmatch(r"[a-z]([a-z0-9]|_[a-z0-9])*", f.name) for f in fields_of(name))


@pytest.mark.parametrize("frame", ["", "a", "head", "mount", "x" * 9])
@pytest.mark.parametrize("samples", [1, 2])
def test_samples_with_a_header_are_decoded_by_another_and_come_back(frame, samples, store):
    (chunk,) = cut_chunks(np.arange(6.0 * samples, dtype=np.float32).reshape(samples, 3, 2), 1000.0,
                   samples=samples)  # fmt: skip
    body = encode_samples(chunk)
    data = messages.add_header(body, 1_700_000_000_123_456_789, frame)
    assert messages.strip_header(data) == body
    found = store.deserialize_cdr(data, messages.SAMPLES)
    assert (found.header.frame_id, found.header.stamp.sec) == (frame, 1_700_000_000)
    assert found.header.stamp.nanosec == 123_456_789
    assert found.seq.tolist() == chunk.seq.tolist() and found.t_ns.tolist() == chunk.t_ns.tolist()
    assert found.values.tobytes() == chunk.values.tobytes()
    assert found.valid.tolist() == chunk.valid.ravel().tolist()


@pytest.mark.parametrize("utc_ns", [-5, 2**62])
def test_a_time_that_ros_2_has_not_is_the_nearest_that_it_has(utc_ns, store):
    data = messages.array_message(small_spec(), "a", utc_ns)
    stamp = store.deserialize_cdr(data, messages.ARRAY).header.stamp
    assert (stamp.sec, stamp.nanosec) == ((0, 0) if utc_ns < 0 else (2**31 - 1, 0))


@pytest.mark.parametrize(
    "text", [b"{}", b'{"t_ns": "x"}', b'{"t_ns": 1e400}', b'{"step": -1, "source": 3}', b"{no"]
)
def test_json_of_any_kind_stays_whole_and_tells_what_it_can(text):
    assert messages.json_of(messages.DECISION, messages.decision_message(text)) == text
    assert messages.json_of(messages.EVENT, messages.event_message(text)) == text


def test_a_decision_s_prediction_set_and_probabilities():
    said = {"type": "decision", "probabilities": {"a": 0.25, "b": 0.75}, "coverage": 0.9,
            "prediction_set": ["b"], "final": True, "t_ns": 2, "utc_ns": 10**9 + 7}  # fmt: skip
    found = cdr.decode(messages.DECISION, messages.decision_message(msgspec.json.encode(said)))
    assert (found["labels"], found["probabilities"]) == (["a", "b"], [0.25, 0.75])
    assert (found["coverage"], found["prediction_set"], found["is_final"]) == (0.9, ["b"], True)
    assert found["header"]["stamp"] == {"sec": 1, "nanosec": 7}
    said = {"names": ["box", "crate"], "names_coverage": 0.9, "object": "my cup",
            "object_margin": 0.25, "object_touches": 2}  # fmt: skip
    found = cdr.decode(messages.DECISION, messages.decision_message(msgspec.json.encode(said)))
    assert {name: found[name] for name in said} == said
    none = cdr.decode(messages.DECISION, messages.decision_message(b'{"coverage": null}'))
    assert math.isnan(none["coverage"]) and math.isnan(none["object_margin"])


def test_only_one_element_that_measures_a_whole_force_in_newton_has_a_wrench():
    one = replace(small_spec(1), channels=("fx", "fy", "fz"), units=("N", "N", "N"))
    values = np.array([[[1, 2, 3]]], np.float32)
    (row,) = messages.wrenches_of(one, values).tolist()
    assert row == [1, 2, 3, 0, 0, 0]
    moved = replace(one, positions=((0.0, 0.0, 0.5),))
    (row,) = messages.wrenches_of(moved, values).tolist()
    assert row == [1, 2, 3, -1, 0.5, 0]
    two = replace(small_spec(2), channels=one.channels, units=one.units)
    for other in (small_spec(1), replace(one, units=("N", "N", "V")), two):
        assert messages.wrenches_of(other, np.ones((1, *other.shape), np.float32)) is None
