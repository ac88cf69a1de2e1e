"""Topics of bags that the rosbags library wrote, whole and damaged."""

import random

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, RecordingError, TactileError
from tactile_rt.core.stream import concatenate
from tactile_rt.recording import Recording
from tactile_rt.recording.importing.bag import bag_topics, import_bag
from tactile_rt.recording.importing.bag_file import is_bag
from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2.cdr import schema_text
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.recordings import odd_chunks, write

rosbags = pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

T0, STEP, N = 1_700_000_000_000_000_000, 10_000_000, 60
FORMS = ("ros1", "sqlite3", "mcap")


def bag(folder, form, told=False):
    """A bag with wrenches, an array, chatter, and samples of ours."""
    if form == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = folder / "a.bag"
        with Writer1(path) as writer:
            fill(store, writer, store.serialize_ros1, {"seq": 3})
        return path
    store = get_typestore(Stores.ROS2_HUMBLE)
    path = folder / form
    with Writer2(path, version=9, storage_plugin=StoragePlugin[form.upper()]) as writer:
        fill(store, writer, store.serialize_cdr, {})
        for message in (messages.SAMPLES, messages.ARRAY):
            store.register(get_types_from_msg(schema_text(message), message))
        ours = writer.add_connection("/skin/samples", messages.SAMPLES, typestore=store)
        for k, chunk in enumerate(our_chunks()):
            stamp = T0 + int(chunk.t_ns[-1])
            writer.write(ours, T0 + k, messages.add_header(encode_samples(chunk), stamp, "mount"))
        if told:
            array = writer.add_connection("/skin/array", messages.ARRAY, typestore=store)
            writer.write(array, T0, messages.array_message(small_spec(), "skin", T0))
    return path


def our_chunks():
    values = np.random.default_rng(1).normal(size=(30, *small_spec().shape))
    return cut_chunks(values, 1000.0, samples=7, start_ns=10**9)


def fill(store, writer, serialized, header):
    types = store.types
    wrench = types["geometry_msgs/msg/WrenchStamped"]
    numbers = types["std_msgs/msg/Float32MultiArray"]
    text = types["std_msgs/msg/String"]
    layout, size = types["std_msgs/msg/MultiArrayLayout"], types["std_msgs/msg/MultiArrayDimension"]
    vector, time = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"]
    topics = {
        kind: writer.add_connection(name, kind.__msgtype__, typestore=store)
        for name, kind in (("/ft/wrench", wrench), ("/skin", numbers), ("/talk", text))
    }
    for k in range(N):
        t_ns = T0 + k * STEP
        loads = types["geometry_msgs/msg/Wrench"](
            force=vector(x=0.5 * k, y=1.0, z=2.0), torque=vector(x=3.0, y=4.0, z=-k)
        )
        head = types["std_msgs/msg/Header"](
            **header, stamp=time(sec=t_ns // 10**9, nanosec=t_ns % 10**9), frame_id="tool0/ft"
        )
        dims = [size(label="taxel", size=4, stride=12), size(label="axis", size=3, stride=3)]
        said = {
            wrench: wrench(header=head, wrench=loads),
            numbers: numbers(
                layout=layout(dim=dims, data_offset=0), data=np.arange(12, dtype=np.float32) + k
            ),
            text: text(data="hello"),
        }
        for kind, message in said.items():
            writer.write(topics[kind], t_ns + 1000, serialized(message, kind.__msgtype__))


def imported(path, output, **options):
    made = import_bag(path, output, **options)
    return made, concatenate(list(Recording(output))), Recording(output).description


@pytest.mark.parametrize("form", FORMS)
def test_wrenches_are_samples_of_one_element_by_their_headers_times(tmp_path, form):
    path = bag(tmp_path, form)
    assert is_bag(path)
    made, chunk, about = imported(path, tmp_path / "o.mcap", topic="/ft/wrench")
    assert (made.samples, made.intact, made.corrupt) == (N, N, 0)
    assert about.spec.elements == ("tool0_ft",)
    assert about.spec.channels == ("fx", "fy", "fz", "mx", "my", "mz")
    assert about.spec.rate_hz == 100 and about.utc_offset_ns == T0
    assert chunk.values[:, 0].tolist() == [[0.5 * k, 1, 2, 3, 4, -k] for k in range(N)]
    assert chunk.t_ns.tolist() == [k * STEP for k in range(N)]


@pytest.mark.parametrize("form", FORMS)
def test_an_array_has_the_shape_of_its_layout_and_the_bags_times(tmp_path, form):
    made, chunk, about = imported(bag(tmp_path, form), tmp_path / "o.mcap", topic="skin")
    assert made.samples == N and about.spec.shape == (4, 3)
    assert chunk.values[5].ravel().tolist() == [k + 5 for k in range(12)]
    assert about.utc_offset_ns == T0 + 1000


@pytest.mark.parametrize("form", ["sqlite3", "mcap"])
def test_samples_of_ours_come_back_bit_for_bit(tmp_path, form):
    _made, chunk, about = imported(bag(tmp_path, form), tmp_path / "o.mcap", topic="/skin/samples")
    ours = concatenate(our_chunks())
    assert chunk.values.tobytes() == ours.values.tobytes()
    assert chunk.t_ns.tolist() == ours.t_ns.tolist() and chunk.seq.tolist() == ours.seq.tolist()
    assert about.spec.elements[0] == "T0" and about.spec.rate_hz == 1000
    assert about.utc_offset_ns == T0


def test_the_array_of_samples_of_ours_is_told_in_the_bag(tmp_path):
    path = bag(tmp_path, "mcap", told=True)
    _, chunk, about = imported(path, tmp_path / "o.mcap", topic="/skin/samples")
    assert about.spec == small_spec()
    assert chunk.values.tobytes() == concatenate(our_chunks()).values.tobytes()


def test_columns_say_what_nobody_knows(tmp_path):
    columns = "wrench.force.x=S.fx:mN,header.seq=count"
    made, chunk, _ = imported(
        bag(tmp_path, "ros1"), tmp_path / "o.mcap", topic="/ft/wrench", columns=columns
    )
    assert made.samples == 1 and chunk.values.ravel().tolist() == [0.0]  # one count, all the time
    assert any("repeat the count" in note for note in made.notes)


def test_topics_are_told_with_what_they_are(tmp_path):
    topics = {t.name: t for t in bag_topics(bag(tmp_path, "mcap"))}
    assert set(topics) == {"/ft/wrench", "/skin", "/talk", "/skin/samples"}
    assert topics["/skin"].messages == N and topics["/talk"].columns == ""
    assert topics["/ft/wrench"].columns.startswith("wrench.force.x=tool0_ft.fx:N,")


def file_of(path):
    """The file that holds the messages of a bag."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


@pytest.mark.parametrize("form", FORMS)
def test_half_a_bag_is_imported_with_a_note_or_refused_with_what_mends_it(tmp_path, form):
    path = file_of(bag(tmp_path, form))
    half = tmp_path / f"half{path.suffix}"
    half.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    if form == "mcap":
        made, chunk, _ = imported(half, tmp_path / "o.mcap", topic="/ft/wrench")
        assert 5 < made.samples < N and chunk.values[3, 0, 0] == 1.5
        assert any("its end is missing or damaged" in note for note in made.notes)
        return
    with pytest.raises(RecordingError, match=r"cannot be read as a bag: .*reindex`"):
        import_bag(half, tmp_path / "o.mcap", topic="/ft/wrench")


@pytest.mark.parametrize("form", FORMS)
def test_damage_raises_nothing_but_our_errors(tmp_path, form):
    path = file_of(bag(tmp_path, form))
    whole, draw = path.read_bytes(), random.Random(3)
    hurt = tmp_path / f"hurt{path.suffix}"
    for k in range(12):
        data = bytearray(whole[: draw.randrange(len(whole))] if k % 2 else whole)
        for _ in range(3):
            data[draw.randrange(len(data))] = draw.randrange(256)
        hurt.write_bytes(data)
        try:
            import_bag(hurt, tmp_path / "o.mcap", "/ft/wrench")
        except TactileError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, r"has the topics /ft/wrench \(geometry_msgs/msg/WrenchStamped\), .*: name one with"),
        ({"topic": "/wrench"}, "no topic '/wrench'; did you mean /ft/wrench"),
        ({"topic": "/talk"}, "no message of /talk is whole and holds a number"),
        ({"topic": "/skin", "columns": "data.99=S.x"}, "no column 'data.99'"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, options, why):
    with pytest.raises((ConfigError, RecordingError), match=why):
        import_bag(bag(tmp_path, "sqlite3"), tmp_path / "o.mcap", **options)
    assert not (tmp_path / "o.mcap").exists()


def test_a_recording_is_no_bag_to_import(tmp_path):
    path = write(tmp_path / "run.mcap", odd_chunks())
    with pytest.raises(ConfigError, match="is a recording already"):
        import_bag(path, tmp_path / "o.mcap")


def test_a_message_that_nobody_knows_is_told_with_its_fields(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("int32[4] taxels\nstring said\n", "mine/msg/Skin"))
    skin = store.types["mine/msg/Skin"]
    with Writer2(tmp_path / "skin", version=9) as writer:
        topic = writer.add_connection("/skin", "mine/msg/Skin", typestore=store)
        for k in range(20):
            message = skin(np.arange(4, dtype=np.int32) + k, "")
            writer.write(topic, k, store.serialize_cdr(message, "mine/msg/Skin"))
    with pytest.raises(ConfigError, match=r"of none is known what is what: `tactile-rt sniff` pro"):
        import_bag(tmp_path / "skin", tmp_path / "out.mcap")
    with pytest.raises(ConfigError, match=r"e\.g\. .*; its fields are taxels\.\{0\.\.3\}"):
        import_bag(tmp_path / "skin", tmp_path / "out.mcap", "/skin")
    columns = "taxels.{0..3}=T{0..3}.value:1"
    made = import_bag(tmp_path / "skin", tmp_path / "out.mcap", columns=columns)
    assert made.samples == 20
