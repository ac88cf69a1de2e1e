"""What an import tells adds up to what the file holds: bytes, lines, messages."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bench.drivers.fuzzing import wire_of
from tactile_rt.core.errors import RecordingError
from tactile_rt.drivers.logs import read_log
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording.importing.bag import bag_topics, import_bag
from tactile_rt.recording.importing.report import report_lines
from tactile_rt.recording.importing.wire import import_wire

SLOW = {"deadline": None, "suppress_health_check": list(HealthCheck)}
FRAME = 37  # bytes of one of bota's


@settings(max_examples=4, **SLOW)
@given(
    st.dictionaries(
        st.integers(1, 38), st.sampled_from([b"", b"\x00" * 5, b"\xaa" * 9]), max_size=4
    ),
    st.integers(0, FRAME - 1),
)
def test_bytes_are_read_or_passed_over(tmp_path, noise, tail):
    packets = wire_of(make_codec("serial", "bota", {}))
    data = b"".join(noise.get(k, b"") + p for k, p in enumerate(packets)) + packets[0][:tail]
    (tmp_path / "raw.bin").write_bytes(data)
    made = import_wire(read_log(tmp_path / "raw.bin"), tmp_path / "o.mcap", {"codec": "bota"})
    assert (made.unit, made.total) == ("bytes", len(data))
    assert made.read == FRAME * made.intact == FRAME * len(packets)
    assert made.read + made.passed_over == made.total
    assert made.notes == ([f"it ends with {tail} bytes of no whole sample"] if tail else [])


def arrays(folder, sizes, layout=None):
    """A bag of ROS 2 with one array of each size; its numbers are those of their places."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types, kind = store.types, "std_msgs/msg/Float32MultiArray"
    dim, dims = types["std_msgs/msg/MultiArrayDimension"], types["std_msgs/msg/MultiArrayLayout"]
    with Writer(folder, version=9) as writer:
        topic = writer.add_connection("/skin", kind, typestore=store)
        for k, n in enumerate(sizes):
            shape = [dim(label="", size=s, stride=0) for s in (layout or {}).get(k, ())]
            message = types[kind](dims(shape, 0), np.arange(n, dtype=np.float32))
            writer.write(topic, 10**18 + k * 10**7, store.serialize_cdr(message, kind))
    return folder


@settings(max_examples=4, **SLOW)
@given(st.lists(st.integers(0, 6), min_size=2, max_size=12).filter(any))
def test_messages_of_any_size_are_samples_of_the_largest(tmp_path_factory, sizes):
    folder = tmp_path_factory.mktemp("bag")
    bag = arrays(folder / "bag", sizes)
    made = import_bag(bag, folder / "o.mcap")
    fewer = [k for k, n in enumerate(sizes, 1) if n < max(sizes)]
    assert (made.unit, made.total, made.read) == ("messages", len(sizes), len(sizes))
    assert made.invalid == len(fewer) and len(made.ranges) == max(sizes)
    assert made.ranges[f"T{max(sizes) - 1}.value"] == (max(sizes) - 1,) * 2
    told = "messages that lack some of the numbers, which are invalid"
    assert made.notes == ([f"{told}: {len(fewer)} (message {fewer[0]})"] if fewer else [])
    assert bag_topics(bag)[0].columns.startswith("data")


def test_an_array_of_another_number_of_channels_is_no_sample(tmp_path):
    bag = arrays(tmp_path / "bag", [12, 8, 12, 6], {0: (4, 3), 1: (4, 2), 2: (4, 3), 3: (2, 3)})
    made = import_bag(bag, tmp_path / "o.mcap")
    assert (made.intact, made.corrupt, made.passed_over) == (3, 1, 1)
    assert "messages of another number of channels, left out: 1 (message 2)" in made.notes


def test_columns_are_proposed_for_messages_that_nobody_knows(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float32[] values\nstring name\n", "mine/msg/Pad"))
    store.register(get_types_from_msg("uint32 seq\nmine/Pad[] pads\n", "mine/msg/Pads"))
    pad, pads = store.types["mine/msg/Pad"], store.types["mine/msg/Pads"]
    with Writer(tmp_path / "bag", version=9) as writer:
        topic = writer.add_connection("/pads", "mine/msg/Pads", typestore=store)
        for k, shape in enumerate([[], [2, 3], [3, 1], [3, 3]]):
            found = [pad(np.arange(n, dtype=np.float32), "x" * 40 * (k == 2)) for n in shape]
            message = store.serialize_cdr(pads(k, found), "mine/msg/Pads")
            writer.write(topic, 10**18 + k * 10**7, message)
    (about,) = bag_topics(tmp_path / "bag")
    assert about.columns == ""
    assert about.proposed == "pads.0.values.{0..2}=T0.c{0..2},pads.1.values.{0..2}=T1.c{0..2}"
    made = import_bag(tmp_path / "bag", tmp_path / "o.mcap", columns=about.proposed)
    assert (made.samples, made.invalid) == (4, 3)
    assert any("invalid: 3 (message 1)" in note for note in made.notes)


def test_a_bag_without_a_number_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="no message of /skin is whole and holds a number"):
        import_bag(arrays(tmp_path / "bag", [0, 0]), tmp_path / "o.mcap", "/skin")


def test_what_a_counter_misses_and_a_frame_lacks_is_told_with_its_place(tmp_path):
    frames = [f for p in wire_of(make_codec("can", "aft200", {})) for f in p]
    lines = [f"({k / 100:.6f}) can0 {f.id:03X}#{f.data.hex()}" for k, f in enumerate(frames)]
    lines[20] = lines[20][:-2]
    (tmp_path / "can.log").write_text("\n".join(lines) + "\n\nnoise\n")
    made = import_wire(read_log(tmp_path / "can.log"), tmp_path / "o.mcap", {"codec": "aft200"})
    assert (made.unit, made.total, made.passed_over) == ("lines", len(lines) + 1, 1)
    assert f"passed over, no line of a candump log: 1 (line {len(lines) + 2})" in made.notes
    assert "corrupt frames: 1 (frame 21)" in made.notes
    assert report_lines(made)[1].startswith("81 lines: 80 read, 1 passed over, 0 out of order")
    assert made.said_hz == 1000 and made.rate_hz == made.found_hz
    assert made.found_hz == pytest.approx(50, rel=0.03)
