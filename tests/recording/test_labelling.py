"""From recordings and intervals to a set: objects, splits, and what is left out."""

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.model_file import METADATA_KEY, shipped_model
from tactile_rt.core.errors import ConfigError, ModelError, RecordingError, SpecMismatch
from tactile_rt.core.stream.sensor_spec import ChannelSpec, SensorSpec
from tactile_rt.recording import Recording, labelling
from tactile_rt.recording.labelled_set import write_set
from tactile_rt.recording.labelling import find_labelled, intervals_beside, intervals_of_all, like
from tactile_rt.recording.labels import LabelledInterval
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import read_object, read_sweeps
from tests.helpers.labelled import ARRAY, KINDS, chunks_of_touches, record_touches, times
from tests.helpers.recordings import write
from tests.helpers.tiny_sweeps import plate, write_tiny_set

HEADER = "recording,start_s,end_s,label,object\n"


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A recording of four touches: mug, cup, mug, cup."""
    return record_touches(tmp_path_factory.mktemp("night") / "night.mcap", [*KINDS[::-1]] * 2)


def row(k, label, thing="", name="night.mcap", later=0.0):
    start, end = times(k)
    return f"{name},{start + later:.2f},{end + later:.2f},{label},{thing}\n"


def labelled(night, tmp_path, text):
    path = tmp_path / "said.csv"
    path.write_text(HEADER + text)
    (path.parent / "night.mcap").unlink(missing_ok=True)
    (path.parent / "night.mcap").symlink_to(night)
    return find_labelled([night], intervals_beside([night], path))


def test_a_touch_is_of_the_interval_in_which_it_begins(night, tmp_path):
    found = labelled(night, tmp_path, row(0, "mug", "red") + row(1, "cup") + row(2, "mug", "blue"))
    assert [u.interval.label for u in found.used] == ["mug", "cup", "mug"]
    assert found.left_out == ["touches outside every interval: 1, first night.mcap at 12.40 s"]
    manifest = write_set(tmp_path / "set", found)
    assert manifest == SweepManifest.read(tmp_path / "set")
    assert manifest.categories == ("cup", "mug") and manifest.recorded and manifest.version == 3
    (alone,) = (n for n in manifest.names() if n.startswith("cup@night-"))
    assert set(manifest.names()) == {alone, "mug@red", "mug@blue"}
    values, about = read_object(tmp_path / "set", "mug@blue")
    assert values.shape == (1, 310, *ARRAY.shape)
    assert about["recording"].tolist() == ["night.mcap"]
    assert about["onset_s"] == pytest.approx([9.02], abs=0.03)


def test_what_cannot_be_used_is_counted(night, tmp_path):
    text = (
        row(0, "mug", later=1.3)  # begins after the onset
        + row(1, "cup")
        + row(1, "plate", later=0.1)
        + row(2, "mug")
        + "night.mcap,9.6,10,cup,\n"  # within the window of the touch before
        + row(3, "cup")
    )
    found = labelled(night, tmp_path, text)
    assert [u.interval.label for u in found.used] == ["cup"]
    said = "; ".join(found.left_out)
    assert "touches outside every interval: 1, first night.mcap at 2.2" in said
    assert "touches in intervals that overlap and name different things: 1, " in said
    assert "touches that run into the interval of another thing: 1, " in said
    assert re.search(r"intervals in which no touch begins: 2, first \S+said.csv:2", said)


def test_lost_samples_and_recordings_without_labels_are_told(night, tmp_path):
    chunks = chunks_of_touches(["mug", "mug"])
    path = write(tmp_path / "gaps.mcap", chunks[:10] + chunks[12:130] + chunks[160:], ARRAY)
    intervals = {path: [LabelledInterval(label="mug")], night: []}
    said = "; ".join(find_labelled([path, night], intervals).left_out)
    assert "samples missing in gaps.mcap: 160" in said
    assert "touches with lost or invalid samples in their window: 1, first gaps.mcap" in said
    assert "no interval of night.mcap is labelled" in said
    assert "touches outside every interval: 4, " in said


def test_a_set_is_there_whole_or_not_at_all(night, tmp_path):
    found = find_labelled([night], intervals_of_all([night]))

    def fail(folder):
        assert len(list(folder.glob("*.npz"))) == 4
        raise OSError("the disk is full")

    before = write_set(tmp_path / "set", found)
    for name in ("set", "other"):
        with pytest.raises(OSError, match="full"):
            write_set(tmp_path / name, found, seed=1, finish=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert SweepManifest.read(tmp_path / "set") == before


def test_three_recordings_of_a_label_are_its_objects(tmp_path):
    files = [record_touches(tmp_path / f"mug-{k}.mcap", ["mug"] * 2, seed=k) for k in range(3)]
    files.append(record_touches(tmp_path / "cup.mcap", ["cup"] * 4, seed=9))
    found = find_labelled(files, labelling.intervals_by_name(files))
    manifest = write_set(tmp_path / "set", found)
    kinds = [name.split("@")[0] for name in manifest.names()]
    assert (kinds.count("mug"), kinds.count("cup")) == (3, 4)
    for split in ("train", "validation", "test"):
        sweeps = read_sweeps(tmp_path / "set", split)
        assert set(sweeps.labels.tolist()) == {0, 1}
        assert sweeps.recorded.all()
    assert found.left_out == [
        "touches of cup, each taken for an object of its own: 4; an accuracy says nothing of "
        "other things: fill in the column object, or record 3 files"
    ]
    again = write_set(tmp_path / "again", found)
    assert again.split == manifest.split
    other = write_set(tmp_path / "other", found, seed=1)
    assert other.split != manifest.split and set(other.names()) == set(manifest.names())


@pytest.mark.parametrize(
    ("objects", "sizes"), [(1, (1, 0, 0)), (2, (1, 1, 0)), (3, (1, 1, 1)), (20, (14, 3, 3))]
)
def test_shares_are_of_each_category_and_some_of_each_are_trained(night, tmp_path, objects, sizes):
    found = find_labelled([night], intervals_of_all([night]))
    found.used = [
        replace(found.used[0], interval=LabelledInterval(label=kind, object=str(k)))
        for kind in KINDS
        for k in range(objects)
    ]
    manifest = write_set(tmp_path / "set", found)
    for kind in KINDS:
        mine = [sum(n.startswith(kind) for n in names) for names in manifest.split.values()]
        assert tuple(mine) == sizes
    none = write_set(tmp_path / "none", found, (1, 0, 0))
    assert not none.split["validation"] and not none.split["test"]
    for bad in ((0.5, 0.5), (0, 1, 0), (1, -1, 0), (1, np.nan, 0), (1e308,) * 3):
        with pytest.raises(ConfigError, match="--shares must be TRAIN,VALIDATION,TEST"):
            write_set(tmp_path / "bad", found, bad)


def test_a_recording_is_on_one_side_whatever_it_is_called(night, tmp_path, monkeypatch):
    link, copy = tmp_path / "link.mcap", tmp_path / "copy.mcap"
    link.symlink_to(night)
    copy.write_bytes(night.read_bytes())
    monkeypatch.chdir(night.parent)
    for other in (link, copy, Path("night.mcap")):
        two = [night, other]
        with pytest.raises(ConfigError, match=f"{night} and {other} are the same recording: name"):
            find_labelled(two, intervals_of_all(two))
    with pytest.raises(ConfigError, match="is named twice: name it once"):
        find_labelled([night, night], intervals_of_all([night]))


def test_a_touch_that_two_recordings_hold_counts_once(night, tmp_path):
    other = write(tmp_path / "again.mcap", list(Recording(night)), ARRAY)
    found = find_labelled([night, other], intervals_of_all([night, other]))
    assert [u.recording for u in found.used] == [night] * 4
    assert found.left_out == [
        "touches that an earlier recording holds, too: 4, first again.mcap at 2.21 s"
    ]


@pytest.mark.parametrize("letter", ["n", "漢"])
def test_the_longest_names_fit_into_a_file_s(night, tmp_path, letter):
    path = tmp_path / f"{letter * (245 // len(letter.encode()))}.mcap"
    path.write_bytes(night.read_bytes())
    longest = letter * (60 if letter == "n" else 40)
    intervals = [LabelledInterval(label=longest, end_s=5.0, object=longest)]
    intervals.append(LabelledInterval(label=longest, start_s=5.0))
    found = find_labelled([path], {path: intervals})
    manifest = write_set(tmp_path / "set", found)
    assert len(manifest.names()) == 4
    assert sum(len(read_object(tmp_path / "set", n)[0]) for n in manifest.names()) == 4


def test_recordings_and_patterns_of_other_arrays_are_refused(night, tmp_path):
    other = record_touches(tmp_path / "other.mcap", ["mug"], spec=replace(plate(1, 4), rate_hz=250))
    both = [night, other]
    with pytest.raises(SpecMismatch, match=r"other.mcap has another array than .*night.mcap"):
        find_labelled(both, intervals_of_all(both))
    write_tiny_set(tmp_path / "set", spec=plate(1, 4))
    with pytest.raises(SpecMismatch, match=r"night.mcap has another array than .*set"):
        find_labelled([night], intervals_of_all([night]), tmp_path / "set")
    for name, said in (("no.mcap", "no recording"), ("no.txt", "no recording")):
        with pytest.raises(ConfigError, match=said):
            find_labelled([tmp_path / name], {})
    (tmp_path / "bad.mcap").write_bytes(night.read_bytes()[:5000])
    with pytest.raises(RecordingError, match=r"bad.mcap is cut short"):
        find_labelled([tmp_path / "bad.mcap"], {})


NEWTON = {"name": "fx", "unit": "N", "range": 1.0, "resolution": 0.01}


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        ({"channels": 5}, r"sensor: Expected `array`, got `int` - at `\$.channels`"),
        ({"nothing": 5}, "sensor: Object missing required field `channels`"),
        ({"channels": []}, "sensor: has no channels"),
        ({"channels": [NEWTON | {"range": -1.0}]}, "sensor: channel 'fx': range must be 0 or more"),
        ({"channels": [NEWTON], "rate_hz": 9.0}, "is damaged: its sensor has 1 channels, its arr"),
    ],
)
def test_a_model_with_an_odd_sensor_is_told_in_a_line(tmp_path, sensor, said):
    onnx = pytest.importorskip("onnx")
    model, path = onnx.load(shipped_model()), tmp_path / "odd.onnx"
    (card,) = (p for p in model.metadata_props if p.key == METADATA_KEY)
    card.value = msgspec.json.encode(msgspec.json.decode(card.value) | {"sensor": sensor}).decode()
    onnx.save(model, path)
    with pytest.raises((ModelError, RecordingError), match=rf"odd\.onnx .*{said}") as error:
        like(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("period_ns", [0, -5, 1, 10**30])
def test_a_set_whose_samples_come_at_no_period_is_told(tmp_path, period_ns):
    write_tiny_set(tmp_path / "set", spec=ARRAY)
    manifest = tmp_path / "set" / "manifest.json"
    text = manifest.read_text()
    assert text.count('"period_ns": 9000000') == 1
    manifest.write_text(text.replace("9000000", str(period_ns)))
    with pytest.raises(RecordingError, match=f"set is damaged: a sample period of {period_ns} ns"):
        like(tmp_path / "set")


def test_sensor_and_period_are_those_of_the_pattern(night, tmp_path):
    write_tiny_set(tmp_path / "set", spec=ARRAY, period_ns=12_000_000)
    channels = tuple(
        ChannelSpec(name=c, unit=u, range=1.0, resolution=2e-6 if u == "N" else 1e-8)
        for c, u in zip(ARRAY.channels, ARRAY.units, strict=True)
    )
    sensor = SensorSpec(channels=channels, rate_hz=250.0)
    pattern = replace(SweepManifest.read(tmp_path / "set"), sensor=sensor)
    pattern.write(tmp_path / "pattern")
    found = find_labelled([night], intervals_of_all([night]), tmp_path / "pattern")
    manifest = write_set(tmp_path / "night", found)
    assert (manifest.period_ns, manifest.sensor) == (12_000_000, sensor)
