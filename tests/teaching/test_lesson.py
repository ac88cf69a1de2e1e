"""Touches become a model: features, classes, the folder that keeps them, who teaches."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model, verify_model
from tactile_rt.core.errors import ConfigError, RecordingError, SpecMismatch
from tactile_rt.recording import StreamWriter
from tactile_rt.recording.labels import LABELS
from tactile_rt.teaching.head import count_refused, fit_classes, leave_one_out
from tactile_rt.teaching.lesson import ANYTHING_ELSE, MODEL, ORDERS, Lesson
from tactile_rt.teaching.listener import find_motion, measure_changes, measured_floor
from tactile_rt.teaching.model import FewShot
from tactile_rt.teaching.onnx_bytes import OnnxGraph, with_metadata
from tactile_rt.teaching.teacher import Teacher
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.made_up_touches import KINDS, NOISE, RATE_HZ, felt, touch, wrench_spec
from tests.helpers.refusals import refusal

EACH = 6
TAUGHT = [kind for kind in KINDS for _ in range(EACH)]
FEW = FewShot(wrench_spec(), (0.3 * NOISE).astype(np.float32), changes=0.9)


def teach(lesson: Lesson, labels: list[str], seed: int, kinds: list[str] | None = None) -> None:
    """Teach touches, of these kinds if not of what they are called, as the command does."""
    chunks = cut_chunks(felt(kinds or labels, seed), RATE_HZ)
    path = lesson.next_recording()
    source = ArraySource(wrench_spec(), chunks)
    listener, told = lesson.listener(source.spec), iter(labels)
    with StreamWriter(path, source) as writer:
        for chunk in chunks:
            writer.push(chunk)
            for onset, end, features in listener.push(chunk):
                span = listener.seconds(onset - 20_000_000), listener.seconds(end)
                lesson.add(next(told), features, path.name, span)
    assert next(told, None) is None, "every touch was found"


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    lesson = Lesson.begin(tmp_path_factory.mktemp("lesson") / "a", FEW)
    teach(lesson, TAUGHT, seed=1)
    lesson.learn()
    return lesson


def decided(lesson: Lesson, kinds: list[str], seed: int) -> list[str]:
    classifier = Classifier(lesson.folder / MODEL, wrench_spec())
    found = [d for chunk in cut_chunks(felt(kinds, seed), RATE_HZ) for d in classifier.push(chunk)]
    return [d.label for d in found if d.final]


def test_touches_are_known_and_what_was_never_taught_is_not(taught):
    others = [kind for kind in KINDS for _ in range(10)]
    found = decided(taught, others, seed=2)
    assert np.mean([a == b for a, b in zip(found, others, strict=True)]) >= 0.9
    assert decided(taught, ["twist"] * 10, seed=3).count("unknown") >= 9


def test_the_model_is_one_like_any_other(taught):
    card = load_model(taught.folder / MODEL)[1]
    assert card.labels == (*sorted(KINDS), "unknown") and card.refusals == ("unknown",)
    assert card.provenance["taught"] == dict.fromkeys(KINDS, EACH)
    said = verify_model(taught.folder / MODEL)
    assert any(line.startswith("bad samples") for line in said)


def test_nothing_that_a_robot_lacks_is_imported():
    code = (
        "import sys, tactile_rt.teaching.page, tactile_rt.teaching.teacher;"
        "print([m for m in ('torch', 'onnx', 'mujoco', 'sklearn', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_lesson_that_is_read_again_has_felt_the_same(taught):
    again = Lesson.read(taught.folder)
    assert [t.label for t in again.touches] == TAUGHT and not again.lost
    for one, other in zip(again.touches, taught.touches, strict=True):
        np.testing.assert_allclose(one.features, other.features, rtol=1e-5, atol=1e-5)


def test_a_lesson_goes_on(taught, tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press", "press", "slide"], seed=4)
    assert lesson.taught_enough == ("press",)
    lesson = Lesson.read(tmp_path / "b")
    teach(lesson, ["slide", "slide"], seed=5)
    assert lesson.undo().label == "slide"
    assert [t.label for t in Lesson.read(tmp_path / "b").touches] == ["press"] * 2 + ["slide"] * 2
    assert lesson.learn().classes == ("press", "slide")


def test_what_an_interruption_leaves_is_dropped_and_counted(taught, tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press"] * 3, seed=6)
    path, recording = tmp_path / "b" / LABELS, tmp_path / "b" / "session-1.mcap"
    path.write_text(path.read_text() + "session-1.mcap,99.5,100.5,press,\nsession-1.mcap,12")
    recording.write_bytes(recording.read_bytes()[:-200])  # its end was not written
    again = Lesson.read(tmp_path / "b")
    assert (len(again.touches), again.lost) == (3, 2)
    teach(again, ["press"], seed=7)
    assert [t.recording for t in again.touches][-1] == "session-2.mcap"


def test_a_touch_is_taken_back_by_its_own_line(taught, tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press", "slide"], seed=6)
    path = tmp_path / "b" / LABELS
    whole = path.read_text().splitlines(keepends=True)
    lost = "session-1.mcap,99.5,100.5,double,\r\n"  # after all that the recording has kept
    for text in (whole[0] + lost + "".join(whole[1:]), "".join(whole) + lost):
        path.write_text(text, newline="")
        again = Lesson.read(tmp_path / "b")
        assert again.lost == 1
        assert again.undo().label == "slide"
        left = path.read_bytes().decode()
        assert "slide" not in left and "press" in left and lost in left
        assert again.undo().label == "press" and again.undo() is None
        assert path.read_bytes().decode() == whole[0] + lost
    path.write_text("".join(whole))
    again = Lesson.read(tmp_path / "b")
    path.write_text(whole[0] + whole[1])  # somebody took the line away by hand
    assert again.undo().label == "slide"
    assert path.read_text() == whole[0] + whole[1]


def test_wherever_a_line_was_torn_the_others_stay(taught, tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press"] * 2, seed=6)
    path = tmp_path / "b" / LABELS
    whole = path.read_bytes()
    last = whole.rfind(b"\n", 0, -1) + 1
    for end in (last + 1, last + 9, len(whole) - 3):
        path.write_bytes(whole[:end])
        assert len(Lesson.read(tmp_path / "b").touches) == 1
        assert path.read_bytes() == whole[:last]
    path.write_bytes(whole + "session-1.mcap,1,2,ü".encode()[:-1])  # within a character
    assert len(Lesson.read(tmp_path / "b").touches) == 2
    assert path.read_bytes() == whole
    path.write_bytes(whole[:-1])  # as an editor may leave it
    assert len(Lesson.read(tmp_path / "b").touches) == 2
    path.write_bytes(whole[:12])
    again = Lesson.read(tmp_path / "b")
    assert not again.touches
    teach(again, ["slide"], seed=7)
    assert [t.label for t in Lesson.read(tmp_path / "b").touches] == ["slide"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.encode("utf-16"), r"labels\.csv:1: not UTF-8 text"),
        (lambda text: text.encode() + "\nsession-1.mcap,1,2,ü,\n".encode("latin-1"), "not UTF-8"),
        (lambda text: b"time,what\n1,2", r"labels\.csv:1: no column 'time'"),
        (lambda text: b"start_s,end_s,label\n1,2,press", r"labels\.csv:1: columns are .* added"),
    ],
)
def test_what_nobody_tore_is_told_and_stays(taught, tmp_path, change, said):
    shutil.copytree(taught.folder, tmp_path / "b")
    path = tmp_path / "b" / LABELS
    path.write_bytes(changed := change(path.read_text()))
    with pytest.raises(ConfigError, match=said):
        Lesson.read(tmp_path / "b")
    assert path.read_bytes() == changed


def test_odd_files_beside_are_one_line(taught, tmp_path):
    shutil.copytree(taught.folder, tmp_path / "b")
    (tmp_path / "b" / LABELS).unlink()
    (tmp_path / "b" / LABELS).symlink_to("/dev/zero")
    with pytest.raises(OSError, match="no file"):
        Lesson.read(tmp_path / "b")
    (tmp_path / "b" / "session-².mcap").touch()
    assert Lesson(tmp_path / "b", taught.taught).next_recording().name == "session-2.mcap"


def test_a_page_may_look_at_any_moment(taught, tmp_path):
    """It looks from a thread of its own: also between a touch that goes and what is made of it."""
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press"] * 4, seed=8)
    teacher = Teacher(lesson, ["press"], 9)
    teacher.progress = replace(teacher.progress, odd=((4, "press"),))
    assert teacher.state()["odd"] == [[4, "press", "press"]]
    lesson.undo()  # and the progress is that of before
    assert teacher.state()["odd"] == []
    assert teacher.obey("a/b") == teacher.state()["said"] != ""


def test_one_touch_of_a_class_is_told_to_be_too_few(taught, tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teach(lesson, ["press", "press", "slide"], seed=8)
    assert Teacher(lesson, [], 2).summary()[-1] == "slide: one touch is too few, and was not learnt"
    teach(lesson, ["slide"] * 5, seed=9)
    said = "press: 2 touches are few: later ones may be called unknown: give it 8 more"
    assert Teacher(lesson, [], 10).summary()[-1] == said


def test_it_says_why_nothing_was_felt(taught):
    listener = taught.listener(wrench_spec())
    assert "no sample came" in listener.hint()
    values = felt([], seed=9)
    for chunk in cut_chunks(values[:15], RATE_HZ):
        assert not list(listener.push(chunk))
    assert "there was no second at rest yet" in listener.hint()
    for chunk in cut_chunks(values[15:], RATE_HZ, start_ns=150_000_000):
        assert not list(listener.push(chunk))
    said = listener.hint()
    (strongest,) = re.findall(r"strongest reading was (\d\.\d) times the noise \(sensor ", said)
    assert 2 < float(strongest) < 6 and said.endswith("and 6 is felt: touch more firmly")
    held = np.tile(values[-1:] + 9, (300, 1, 1))
    for chunk in cut_chunks(held, RATE_HZ, start_ns=3_000_000_000):
        list(listener.push(chunk))
    assert "touched all the while: let go" in listener.hint()


@pytest.mark.parametrize("levels", [0.0, 0.5])
def test_a_rest_in_which_something_moved_is_named(levels):
    spec, rng = wrench_spec(), np.random.default_rng(0)
    values = rng.normal(0, 0.1, (200, len(spec.elements), len(spec.channels)))

    def rest() -> str:
        rounded = np.round(values / levels) * levels if levels else values
        return find_motion(list(cut_chunks(rounded.astype(np.float32), RATE_HZ)), spec)

    assert rest() == ""
    values[60:110, 0, 2] += 3.0
    assert rest() == f"{spec.elements[0]} {spec.channels[2]}"
    values[60:110, 0, 2] -= 3.0
    bump = 3.0 * np.sin(np.pi * np.arange(130) / 130)  # touched most of the time
    values[20:150, 0, 2] += bump
    assert rest() == f"{spec.elements[0]} {spec.channels[2]}"


def test_two_classes_that_are_the_same_are_named(tmp_path):
    lesson = Lesson.begin(tmp_path / "lesson", FEW)
    teach(lesson, ["press", "slide"] * 8, seed=3, kinds=["press"] * 16)
    assert Teacher(lesson, [], 8).progress.same == (("press", "slide"),)
    assert "press and slide feel the same: make them one" in Teacher(lesson, [], 8).summary()


def test_what_cannot_be_is_one_line(taught, tmp_path):
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / LABELS).touch()
    with pytest.raises(ConfigError, match=r"holds labels\.csv, but no features\.onnx"):
        Lesson.begin(tmp_path / "others", FEW)
    assert "holds a lesson already" in refusal(Lesson.begin, taught.folder, FEW)
    assert "holds no lesson: there is no features.onnx" in refusal(Lesson.read, tmp_path)
    empty = Lesson.begin(tmp_path / "c", FEW)
    assert "no class has 2 touches yet" in refusal(empty.learn)
    with pytest.raises(SpecMismatch):
        empty.listener(small_spec())
    with pytest.raises(RecordingError, match="delivered nothing at rest"):
        measured_floor([])
    with pytest.raises(ConfigError, match="a class needs 2"):
        fit_classes(np.zeros((3, 2, 5)), ["a", "a", "b"], [slice(None)])


def test_the_floor_is_that_of_the_noise_or_of_the_steps():
    rng = np.random.default_rng(0)
    values = rng.normal(scale=[1e-3, 5.0], size=(400, 3, 2))
    values[..., 1] = np.round(values[..., 1] / 4) * 4  # in steps of 4
    floor = measured_floor(cut_chunks(values, 100.0))
    assert floor[0] == pytest.approx(0.3e-3, rel=0.1)
    assert floor[1] == pytest.approx(0.3 * 5.1, rel=0.1)
    still = cut_chunks(np.full((400, 3, 2), 235.0), 100.0)
    assert (measured_floor(still) > 0).all() and (measured_floor(still) < 1).all()
    assert measure_changes(cut_chunks(values, 100.0)) > 0.9 and measure_changes(still) == 0


def test_a_class_of_two_touches_does_not_let_strangers_through(taught):
    kept = [t for t in taught.touches if t.label != "double"]
    kept += [t for t in taught.touches if t.label == "double"][:2]
    features = np.stack([t.features for t in kept]).astype(float)
    classes = fit_classes(features, [t.label for t in kept], taught.taught.network.kinds)
    listener, chunks = (
        taught.listener(wrench_spec()),
        cut_chunks(felt(["push"] * 10, seed=3), RATE_HZ),
    )
    strangers = np.stack([touch for chunk in chunks for *_, touch in listener.push(chunk)])
    nearest = classes.distances(strangers.astype(float))[:, -1].min(axis=1)
    assert (nearest > classes.reach[-1]).sum() >= 9


@pytest.mark.parametrize("near", [0.9, 1.1, 3.0])
def test_touches_of_anything_else_set_the_reach(taught, near):
    """It stays outside of them, as far as classes allow: 0.9, 1.1, 3 times the usual reach."""
    features = np.stack([t.features for t in taught.touches]).astype(float)[:, -1:]
    kinds = taught.taught.network.kinds
    usual = fit_classes(features, TAUGHT, kinds)
    far = features[:1] + np.geomspace(1e-4, 1e3, 4000)[:, None, None] * features[:1].std()
    away = usual.distances(far)[:, 0].min(axis=1) / usual.reach[0]
    other = far[np.argmax(away > near)][None]
    found = fit_classes(features, TAUGHT, kinds, others=other)
    assert found.reach[0] / usual.reach[0] == pytest.approx(min(near, 1.2), abs=0.1)
    assert count_refused(features, TAUGHT, kinds, other) == (near > 1)


def test_a_touch_under_a_wrong_name_is_found(taught):
    names = list(TAUGHT)
    names[1] = "slide"
    features = np.stack([t.features for t in taught.touches]).astype(float)
    found = leave_one_out(features[:, -1:], names, taught.taught.network.kinds)
    assert not found.right[1] and found.right[2:].mean() >= 0.9


def test_a_touch_is_odd_under_a_wrong_name_and_not_by_chance(taught):
    assert taught.leave_one_out().odd == ()
    own, *others = taught.touches
    wrong = replace(taught, touches=[replace(own, label="slide"), *others])
    assert wrong.leave_one_out().odd[0] == (1, own.label)


def test_who_teaches_is_led_and_obeyed(tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teacher = Teacher(lesson, ["press", "slide"], 2)
    rng = np.random.default_rng(0)
    size = lesson.taught.network.size

    def take(at: float) -> str:
        features = np.full((22, size), at, np.float32) + rng.normal(size=(22, size)).astype("f")
        return teacher.take(teacher.label, features, "session-1.mcap", (at, at + 1))

    assert teacher.prompt() == "touch it: press (1 of 2)"
    assert "press 1" in take(0)
    assert take(0).endswith("touch it: slide (1 of 2)")
    assert teacher.obey("undo").splitlines() == [
        "touch 2 (press) is taken back", "touch it: press (2 of 2)"
    ]  # fmt: skip
    assert "told apart" not in take(0), "there is one class yet"
    assert teacher.obey("next") == "touch it: press (3)"
    assert teacher.obey("2") == "touch it: slide (1 of 2)"
    take(9)
    said = take(9)
    assert "told apart, leave-one-out: 4 of 4 touches" in said
    assert said.splitlines()[-1].startswith("touch it in any other way, for 20 s")
    teacher.watch(100.0)
    assert "anything else 1, refused:" in take(40)
    teacher.watch(120.0)
    assert not teacher.done and lesson.labels == ("press", "slide")
    teacher.watch(120.1)
    assert teacher.done and teacher.prompt() == "all touches are there"
    assert any("of 1 touches refused" in line for line in teacher.summary())
    teacher.done = False
    assert "cannot be part of a file's name" in teacher.obey("a/b")
    assert teacher.obey("rub") == "touch it: rub (1 of 2)"
    state = teacher.state()
    assert [c["name"] for c in state["classes"]] == ["press", "slide", "rub"]
    assert (state["right"], state["of"], state["label"]) == (4, 4, "rub")
    teacher.obey("done")
    assert teacher.done
    quiet = Teacher(Lesson.begin(tmp_path / "c", FEW), [], 2)
    assert quiet.prompt() == "what is touched next? name it, or choose its number"
    assert "nothing was learnt" in quiet.take("", np.zeros((22, size), "f"), "x", (0, 1))
    assert quiet.obey("undo") == "there is no touch to take back"


def test_how_it_ended_is_what_a_page_shows(taught):
    teacher = Teacher(taught, [], 2)
    assert not teacher.state()["ended"]
    teacher.ended = "model.onnx knows press, slide"
    state = teacher.state()
    assert (state["ended"], state["prompt"]) == (True, "model.onnx knows press, slide")


def test_of_one_class_alone_no_touch_is_called_right(tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teacher = Teacher(lesson, ["press"], 4)
    rng = np.random.default_rng(0)
    for k in range(4):
        features = rng.normal(size=(22, lesson.taught.network.size)).astype(np.float32)
        teacher.take("press", features, "session-1.mcap", (k, k + 1))
    assert teacher.label == ANYTHING_ELSE and teacher.progress.right == (0, 0)
    assert teacher.summary() == ["press is the only class: teach another to compare"]


def test_a_class_may_be_a_number_and_none_is_made_of_one(tmp_path):
    lesson = Lesson.begin(tmp_path / "b", FEW)
    teacher = Teacher(lesson, ["press", "2", "1"], 2)
    assert teacher.obey("1") == "touch it: 1 (1 of 2)", "its name comes before a number"
    assert teacher.obey("press") == "touch it: press (1 of 2)"
    assert teacher.obey("4") == "there is no class 4: there are 3"
    assert teacher.obey("9" * 5000).startswith("there is no class 9999")
    assert teacher.obey("²") == "touch it: ² (1 of 2)", "which is no digit of a number"
    assert (teacher.label, teacher.wanted) == ("²", ["press", "2", "1", "²"])
    for order in ORDERS:
        with pytest.raises(ConfigError, match="is a command of `teach`; choose another label"):
            Teacher(lesson, [order], 2)


def test_the_writer_of_graphs_is_understood_by_others():
    onnx = pytest.importorskip("onnx")
    ort = pytest.importorskip("onnxruntime")
    g = OnnxGraph()
    x = g.input("x", ["batch", 3])
    y = g("Concat", g("Mul", x, g.constant(-2.5)), g("ReduceSum", x, g.integers(1)), axis=1)
    g.output("y", y, ["batch", 4])
    data = g.serialise("two", {"a": "b"})
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    assert {p.key: p.value for p in model.metadata_props} == {"a": "b"}
    values = np.random.default_rng(0).normal(size=(2, 3)).astype("f")
    (found,) = ort.InferenceSession(data).run(None, {"x": values})
    expected = np.concatenate([-2.5 * values, values.sum(1, keepdims=True)], 1)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    other = onnx.load_from_string(with_metadata(data, "a", "c"))
    assert {p.key: p.value for p in other.metadata_props} == {"a": "c"}
    assert other.graph == model.graph


@pytest.mark.parametrize("samples", [1, 10, 100, 10_000])
def test_what_comes_too_soon_is_the_rest_of_a_touch(taught, samples):
    """However many samples come together."""
    rng = np.random.default_rng(8)
    rest, touches = felt([], seed=8), [touch("press", rng) for _ in range(3)]
    slow = np.repeat(touches[0], 2, axis=0)  # longer than what is looked at of it
    # the second begins half a second after the first has ended, the third two seconds
    signal = np.concatenate([rest, slow[:-150], touches[1][100:], touches[2]])
    listener = taught.listener(wrench_spec())
    found = [one for chunk in cut_chunks(signal, RATE_HZ, samples) for one in listener.push(chunk)]
    assert (len(found), listener.hasty) == (2, 1)
