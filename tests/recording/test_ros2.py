"""Recordings in the hands of other people's readers of bags: rosbags and mcap-ros2-support."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from tactile_rt.calibration import Calibration
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.recording import Description, Recording
from tactile_rt.recording.conversion import write_bag
from tactile_rt.recording.replay import DEMO
from tactile_rt.testing import FakeCan, FakeSerial, cut_chunks, small_spec
from tests.helpers.recordings import SPEC, all_parts, noise, record_device, write_as_daemon


def by_rosbags(path):
    """{topic: messages}, all decoded."""
    with AnyReader([path]) as reader:
        found = {c.topic: [] for c in reader.connections}
        for connection, _, data in reader.messages():
            found[connection.topic].append(reader.deserialize(data, connection.msgtype))
    return found


def by_mcap_ros2(path):
    """{topic: messages}, all decoded."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a deprecated way, which is what many use
        from mcap_ros2.reader import read_ros2_messages
    found = {}
    for message in read_ros2_messages(path):
        found.setdefault(message.channel.topic, []).append(message.ros_msg)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert sum(1 for _ in reader.iter_decoded_messages()) == sum(map(len, found.values()))
    return found


def whole(path, **about):
    """A recording with all that one may have but packets."""
    spec = replace(small_spec(1), channels=("fx", "fy", "fz"), units=("N",) * 3, frame="tip")
    said = Description(
        spec, 1_700_000_000_000_000_000, calibration=Calibration.of("it", spec),
        session={"daemon_source": "finger-1", "who": "Ada"}, **about,
    )  # fmt: skip
    chunks = cut_chunks(noise(40, (1, 3)), 1000.0, samples=10)
    chunks[1] = replace(chunks[1], valid=np.zeros((10, 1), np.bool_))
    return write_as_daemon(path, said, chunks), chunks


@pytest.mark.parametrize("make", [FakeSerial, FakeCan])
def test_each_channel_of_a_device_s_recording_is_read_by_both(make, path):
    chunks, _ = record_device(make(noise(50, (4, 6)), pace="fast"), path, 50)
    recording = Recording(path)
    base = f"/tactile/{recording.spec.name}"
    one, other = by_rosbags(path), by_mcap_ros2(path)
    for found in (one, other):
        values = np.concatenate([np.array(m.values, np.float32) for m in found[f"{base}/samples"]])
        assert values.tobytes() == b"".join(c.values.tobytes() for c in chunks)
        for message, (packet, _) in zip(found[f"{base}/wire"], recording.packets(), strict=True):
            assert message.opened == (packet is None)
            if make is FakeSerial:
                assert bytes(message.data) == (packet or b"")
                continue
            frames = [
                CanFrame(f.id, bytes(f.data), f.extended, f.fd, f.remote) for f in message.frames
            ]
            assert frames == list(packet or ())
        (array,) = found[f"{base}/array"]
        assert tuple(array.elements) == recording.spec.elements
        assert [json.loads(m.json)["state"] for m in found[f"{base}/health"]][-1] == "closed"
    assert {t: len(m) for t, m in one.items() if m} == {t: len(m) for t, m in other.items()}


def test_each_channel_of_a_daemon_s_recording_is_read_by_both(path):
    _, chunks = whole(path)
    for found in (by_rosbags(path), by_mcap_ros2(path)):
        assert {t: len(m) for t, m in found.items()} == {
            f"/tactile/finger_1/{name}": n
            for name, n in
            {"samples": 4, "decisions": 4, "events": 1, "health": 1, "array": 1}.items()
        }  # fmt: skip
        assert found["/tactile/finger_1/decisions"][2].label == "m\u00fcg \u2028 2\n"
        assert found["/tactile/finger_1/decisions"][2].step == 2
        for message, chunk in zip(found["/tactile/finger_1/samples"], chunks, strict=True):
            stamp = message.header.stamp
            at_ns = 1_700_000_000_000_000_000 + int(chunk.t_ns[-1])
            assert stamp.sec * 10**9 + stamp.nanosec == at_ns
            assert message.header.frame_id == "tip"
            assert list(message.t_ns) == chunk.t_ns.tolist()
            assert list(message.seq) == chunk.seq.tolist()
            assert list(message.valid) == chunk.valid.ravel().tolist()
        assert found["/tactile/finger_1/events"][0].touching
        assert found["/tactile/finger_1/health"][0].state == "closed"


def test_the_recording_that_is_shipped_is_read_by_both():
    one, other = by_rosbags(DEMO), by_mcap_ros2(DEMO)
    assert {t: len(m) for t, m in one.items() if m} == {t: len(m) for t, m in other.items()}
    values = np.concatenate([m.values for m in one["/tactile/mouse_right/samples"]])
    assert len(values) == 30 * 6 * sum(map(len, Recording(DEMO)))


def test_a_bag_of_several_files_has_a_wrench_for_each_valid_sample(tmp_path):
    (first, chunks), (second, _) = (whole(tmp_path / f"{k}.mcap") for k in range(2))
    assert write_bag([Recording(first), Recording(second)], tmp_path / "bag") == 80
    with AnyReader([tmp_path / "bag"]) as reader:
        topics = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        counted = dict.fromkeys(topics, 0)
        for connection, _, _ in reader.messages():
            counted[connection.topic] += 1
        assert {t: n for t, (_, n) in topics.items()} == counted
        assert reader.message_count == sum(counted.values())
        assert reader.duration == 2**60 + 10**9 - int(chunks[0].t_ns[-1]) + 1
    assert topics["/tactile/finger_1/wrench"] == ("geometry_msgs/msg/WrenchStamped", 60)
    wrenches = by_mcap_ros2(tmp_path / "bag" / "bag_0.mcap")["/tactile/finger_1/wrench"]
    force, last = wrenches[-1].wrench.force, chunks[-1].values[-1, 0]
    assert [force.x, force.y, force.z] == last.astype(float).tolist()
    header = wrenches[-1].header
    assert header.frame_id == "tip"
    assert header.stamp.sec * 10**9 + header.stamp.nanosec == (
        1_700_000_000_000_000_000 + int(chunks[-1].t_ns[-1])
    )


def test_what_is_recovered_is_a_bag_again(path):
    _, chunks = whole(path)
    path.write_bytes(path.read_bytes()[:-60])
    from tactile_rt.recording import recover

    mended = recover(path)
    assert all_parts(Recording(mended)) == all_parts(chunks)
    assert len(by_rosbags(mended)["/tactile/finger_1/array"]) == 1
    write_bag([Recording(mended)], path.parent / "bag")
    assert Recording(path.parent / "bag" / "bag_0.mcap").description.recovered


def test_names_are_of_the_array_where_no_daemon_named_a_source(path):
    about = Description(replace(SPEC, name="2nd finger/tip"), 0)
    write_as_daemon(path, about, cut_chunks(noise(5), 1000.0))
    assert "/tactile/_2nd_finger_tip/samples" in by_rosbags(path)
    assert sum(map(len, Recording(path))) == 5
