"""labels.csv: what was touched when; a mistake is one line, and a line is there whole or not."""

import math

import pytest
from msgspec.structs import replace

from tactile_rt.core.errors import ConfigError
from tactile_rt.recording.labels import LabelledInterval, append_label, label_of_file, read_labels

HEADER = "recording,start_s,end_s,label,object\n"


@pytest.fixture
def night(tmp_path):
    """A recording, as far as its labels are concerned."""
    path = tmp_path / "night.mcap"
    path.touch()
    return path


def read(night, text, also=()):
    path = night.with_name("labels.csv")
    path.write_text(text)
    return read_labels(path, [night, *also])


def test_what_was_appended_is_read(night):
    path = night.with_name("labels.csv")
    said = [
        LabelledInterval(label="mug", start_s=0.25, end_s=12, object="red, with a handle"),
        LabelledInterval(label="plate", start_s=12, end_s=1e4),
    ]
    for one in said:
        append_label(path, "night.mcap", one)
    assert path.read_text().splitlines()[1] == 'night.mcap,0.25,12,mug,"red, with a handle"'
    found = read_labels(path, [night])[night]
    assert [replace(i, where="", recording="") for i in found] == said
    assert found[1].where == f"{path}:3"


def test_what_is_left_of_a_line_spoils_no_other(night):
    path = night.with_name("labels.csv")
    path.write_text(HEADER + "night.mcap,1,2,m")  # the power failed
    append_label(path, "night.mcap", LabelledInterval(label="mug", start_s=3, end_s=4))
    assert path.read_text().splitlines()[1:] == ["night.mcap,1,2,m", "night.mcap,3,4,mug,"]
    with pytest.raises(ConfigError, match=r"labels.csv:2: 4 values for 5 columns"):
        read_labels(path, [night])


def test_nothing_is_appended_that_could_not_be_read(night):
    path = night.with_name("labels.csv")
    for bad in (
        LabelledInterval(label="", start_s=0, end_s=1),
        LabelledInterval(label="mug", start_s=0, end_s=1, object="a/b"),
        LabelledInterval(label="mug", start_s=2, end_s=1),
        LabelledInterval(label="mug", start_s=0, end_s=math.inf),
    ):
        with pytest.raises(ConfigError):
            append_label(path, "night.mcap", bad)
    for bad in ("#1.mcap", "a\nb.mcap"):
        with pytest.raises(ConfigError, match=r"cannot be written in labels.csv"):
            append_label(path, bad, LabelledInterval(label="mug", start_s=0, end_s=1))
    assert not path.exists()
    path.write_text("time,what\n")
    with pytest.raises(ConfigError, match=r"labels.csv:1: columns are time,what, not recording"):
        append_label(path, "night.mcap", LabelledInterval(label="mug", start_s=0, end_s=1))


def test_one_recording_need_not_be_named(night, tmp_path):
    assert read(night, "start_s,end_s,label\n0,1,mug\n")[night][0].label == "mug"
    other = tmp_path / "other.mcap"
    with pytest.raises(ConfigError, match="no column recording, which 2 recordings need; add it"):
        read(night, "start_s,end_s,label\n0,1,mug\n", [other])


def test_recordings_that_are_not_asked_for_are_kept_apart(night, tmp_path):
    (tmp_path / "other.mcap").touch()
    found = read(night, HEADER + "other.mcap,0,1,mug,\n")
    assert found[night] == [] and len(found[tmp_path / "other.mcap"]) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "labels.csv: is empty"),
        ("recording,start_s,end,label\n", "labels.csv:1: no column 'end'; did you mean end_s"),
        ("recording,start_s,end_s\n", "labels.csv:1: no column label; add it"),
        (HEADER + "night.mcap,-1,2,mug,\n", "labels.csv:2: start_s: must be 0 or more, not -1"),
        (HEADER + "\nnight.mcap,3,2,mug,\n", "labels.csv:3: end_s: must be after start_s, 3 s"),
        (HEADER + "night.mcap,1,2,,\n", "labels.csv:2: label: is empty; name what"),
        (HEADER + "night.mcap,1,2,unknown,\n", "labels.csv:2: label: 'unknown' is reserved"),
        (HEADER + "night.mcap,1,2,mug,../x\n", "labels.csv:2: object: '../x' cannot be part"),
        (HEADER + f"night.mcap,1,2,mug,{'漢' * 41}\n", "object: .* too long: 123 bytes, 120 at"),
        (HEADER + "nigth.mcap,1,2,mug,\n", "2: recording: no file 'nigth.mcap' .* mean night.mcap"),
        (HEADER + "a\0b.mcap,1,2,mug,\n", r"2: recording: 'a\\x00b.mcap' is not a file name"),
        (HEADER + f"{'n' * 200_000},1,2,mug,\n", "labels.csv:2: field larger than field limit"),
    ],
)
def test_a_mistake_is_one_line_with_place_and_column(night, text, said):
    with pytest.raises(ConfigError, match=said) as error:
        read(night, text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("mug.mcap", "mug"),
        ("mug-3.mcap", "mug"),
        ("coffee mug_12.npz", "coffee mug"),
        ("mug-3-20261121T170512Z.mcap", "mug"),
        ("mug2.mcap", "mug2"),
    ],
)
def test_a_file_s_name_tells_its_label(tmp_path, name, label):
    assert label_of_file(tmp_path / name) == label


def test_a_name_that_tells_none_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"unknown-1.mcap: its name holds no label"):
        label_of_file(tmp_path / "unknown-1.mcap")
