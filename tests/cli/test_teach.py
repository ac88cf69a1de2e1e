"""`tactile-rt teach`, over a real serial line: taught, gone on with, killed, and used."""

import random
import re
import shlex
import signal
import socket
import subprocess
import threading
import time
import urllib.request
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.cli.teach import _teach
from tactile_rt.core.locks import alone_in
from tactile_rt.recording.labels import LABELS
from tactile_rt.sources.opening import open_source
from tactile_rt.teaching.lesson import Lesson
from tactile_rt.teaching.model import FewShot
from tactile_rt.teaching.page import TeachingPage
from tactile_rt.teaching.teacher import Teacher
from tactile_rt.testing import ArraySource, FakeSerial, cut_chunks
from tests.helpers.made_up_touches import KINDS, NOISE, RATE_HZ, felt, wrench_spec
from tests.helpers.processes import run_program, start_program
from tests.helpers.source_tree import ROOT
from tests.helpers.waiting import until

EACH = 4


def device(kinds, seed, pace="fast"):
    signal = felt(kinds, seed)
    return FakeSerial(np.concatenate([signal, signal[:300]]), "bota", pace=pace)


def url(line, clock="device"):
    return f"{line.url}&clock={clock}&start_s=30"


@pytest.fixture(scope="module")
def lesson(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teach") / "gestures"
    with device([kind for kind in KINDS for _ in range(EACH)], 1) as line:
        done = run_program(
            "teach", url(line), folder, "--classes", ",".join(KINDS), "--touches", EACH
        )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_ten_lines_tell_what_to_do_and_what_was_learnt(lesson):
    folder, out = lesson
    lines = out.splitlines()
    assert lines[0] == "touch nothing for 2 s"
    assert "1 elements x 6 channels at 100 Hz" in lines[1]
    assert lines[2] == f"touch it: press (1 of {EACH})"
    assert f"touch it: slide (1 of {EACH})" in lines
    assert "touch it in any other way, for 20 s: that will be refused" in lines
    assert f"press: {EACH} of {EACH} touches right, leave-one-out" in lines
    assert f"{folder}/model.onnx: knows press, slide, double, and what it does not know" in out
    assert load_model(folder / "model.onnx")[1].refusals == ("unknown",)


def test_what_was_taught_is_decided_over_the_same_line(lesson):
    folder, _ = lesson
    others = [kind for kind in KINDS for _ in range(3)]
    with device(others, 2) as line, open_source(url(line)) as source:
        classifier, found = Classifier(folder / "model.onnx", source.spec), []
        ends = time.monotonic() + 30
        while len(found) < len(others) and time.monotonic() < ends:
            if (chunk := source.read(0.1)) is not None:
                found += [d.label for d in classifier.push(chunk) if d.final]
    assert np.mean([a == b for a, b in zip(found, others, strict=True)]) >= 7 / 9


def test_a_lesson_goes_on_and_lines_are_orders(lesson):
    folder, _ = lesson
    with device(["twist"] * 3, 5) as line:
        words = ("teach", url(line), folder, "--classes", "twist", "--touches", "2")
        done = run_program(*words, input="press\ntwist\n")
    assert done.returncode == 0, done.stderr
    assert f"there already: {EACH} press, {EACH} slide, {EACH} double" in done.stdout
    assert f"touch it: press ({EACH + 1})" in done.stdout, "stdin's lines are orders"
    assert "touch it: twist (1 of 2)" in done.stdout
    assert load_model(folder / "model.onnx")[1].classes == ("double", "press", "slide", "twist")


def test_killed_at_any_moment_it_loses_the_touch_under_way_at_most(tmp_path):
    """Six times in one lesson, which goes on every time."""
    folder, kept = tmp_path / "a", 0
    draw = random.Random(seed := random.randrange(1000))  # other moments every time
    for k in range(6):
        with device(["press", "slide"] * 20, seed + k) as line:
            words = ("teach", url(line), folder, "--classes", "press", "--touches", "999")
            process = start_program(*words, stdin=subprocess.DEVNULL, stderr=None)
            said = []
            reader = threading.Thread(target=lambda p=process, s=said: s.extend(p.stdout))
            reader.start()
            # the last time for long enough that there is something to learn from
            lines = draw.randrange(1, 12) if k < 5 else 12
            until(lambda p=process, s=said, n=lines: len(s) >= n or p.poll() is not None)
            time.sleep(draw.uniform(0, 0.1))
            process.kill()
            process.wait()
            reader.join()
            process.stdout.close()
        told = sum(bool(re.match(r" *\d+  press \d", one)) for one in said)
        if not kept + told and not (folder / "features.onnx").exists():
            continue  # before there was anything to lose
        again = Lesson.read(folder)
        assert kept + told <= len(again.touches) <= kept + told + 1, (seed, k, said)
        assert not again.lost, (seed, k)
        kept = len(again.touches)
    assert kept > 6 and again.learn().classes == ("press",)


def test_one_teaches_at_a_time(refused, tmp_path):
    with alone_in(tmp_path / "gestures"):
        said = refused("teach", "synthetic:2x1", tmp_path / "gestures", "--classes", "press,slide")
    assert "is in use by process" in said
    assert not (tmp_path / "gestures").exists()


def test_mistakes_are_one_line(call, lesson, tmp_path):
    folder, _ = lesson
    for arguments, said in (
        (("synthetic:3x2", tmp_path / "a", "--classes", "a/b"), "cannot be part of a file's name"),
        (("synthetic:3x2", tmp_path / "a", "--classes", "unknown"), "is reserved"),
        (("synthetic:3x2", tmp_path / "a", "--classes", "b,undo"), "is a command of `teach`"),
        (("synthetic:3x2", tmp_path / "a", "--page", "here"), "--page must be HOST:PORT"),
        (("synthetic:3x2", tmp_path / "a\udcff", "--classes", "a"), "is not UTF-8: rename it"),
        (("synthetic:3x2", folder, "--json", folder / LABELS), "is a file of the lesson, or its"),
        (("synthetic:3x2", folder, "--classes", "a"), "or teach in another folder"),
        (("serial:/dev/none?codec=bota", tmp_path / "a", "--classes", "a"), "no such port"),
        (
            ("synthetic:3x2?pace=fast&seconds=3", tmp_path / "b", "--classes", ""),
            "touches kept: 0, too few",
        ),
    ):
        code, _, err = call("teach", *arguments, "--seconds", "60")
        assert code == 2 and said in err and err.count("\n") == 1, (arguments, err)
    assert (folder / LABELS).exists()


def test_a_folder_of_others_is_refused_before_anything_is_begun(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, how: False)
    said = refused("teach", "synthetic:3x2", tmp_path / "a", "--seconds", "5")
    assert "may not be written into" in said


def test_an_address_that_is_taken_is_told_before_anything_is_begun(refused, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        at = f"127.0.0.1:{taken.getsockname()[1]}"
        assert "already in use" in refused("teach", "synthetic:3x2", tmp_path / "a", "--page", at)
    assert not (tmp_path / "a").exists()


def test_ctrl_c_learns_from_what_is_there(tmp_path):
    with device(["press"] * 9, 3, pace="realtime") as line:
        words = ("teach", line.url, tmp_path / "a", "--classes", "press,slide")
        process = start_program(*words, stdin=subprocess.DEVNULL, stderr=subprocess.STDOUT)
        for said in process.stdout:
            if "press 2" in said:
                process.send_signal(signal.SIGINT)
        process.stdout.close()
        assert process.wait(20) == 0
    assert said.startswith("now: tactile-rt run --source ")
    assert load_model(tmp_path / "a" / "model.onnx")[1].classes == ("press",)


def test_ctrl_c_at_rest_leaves_nothing_behind(tmp_path):
    with device([], 3, pace="realtime") as line:
        process = start_program("teach", line.url, tmp_path / "a", stdin=subprocess.DEVNULL)
        assert process.stdout.readline() == "touch nothing for 2 s\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 2 and err.count("\n") == 1 and "touches kept: 0" in err
    assert not (tmp_path / "a").exists()


def test_the_shipped_model_enrols_objects(call, refused, tmp_path):
    pytest.importorskip("numba")
    objects = ",".join(f"teapot-{i}" for i in range(3))
    source = f"sim:mouse?objects={objects}&sweeps=3&pace=fast"
    more = ("--classes", "teapot", "--touches", "3", "--model", "shipped")
    code, out, err = call("teach", source, tmp_path / "a", *more)
    assert (code, err) == (0, "")
    assert "knows teapot beside 13 classes, and what is none of these" in out
    base, card = (load_model(m)[1] for m in (shipped_model(), tmp_path / "a" / "model.onnx"))
    assert card.labels == base.labels and [one.name for one in card.enrolled] == ["teapot"]
    (first, *_) = Lesson.read(tmp_path / "a").touches
    assert first.features.shape == (1, base.embedding)
    said = refused("teach", source, tmp_path / "a", "--model", tmp_path / "a" / "model.onnx")
    assert "go on with its lesson" in said


def test_the_page_shows_and_obeys():
    orders = []
    page = TeachingPage("127.0.0.1", 0, lambda: {"prompt": "touch it"}, orders.append)
    try:

        def ask(path, data=None, **headers):
            request = urllib.request.Request(page.url + path, data, headers)
            with urllib.request.urlopen(request, timeout=5) as answer:
                return answer.status, answer.read()

        assert b"<title>Teach touches" in ask("")[1]
        assert msgspec.json.decode(ask("state")[1]) == {"prompt": "touch it"}
        assert ask("order", b'{"order": "undo"}', **{"content-type": "application/json"})[0] == 202
        assert orders == ["undo"]
        for path, data, headers, status in (
            ("order", b'{"order": ""}', {"content-type": "application/json"}, 400),
            ("order", b'{"order": "undo"}',
             {"content-type": "application/json", "origin": "http://elsewhere.example"}, 403),
        ):  # fmt: skip
            with pytest.raises(urllib.error.HTTPError) as refused:
                ask(path, data, **headers)
            assert refused.value.code == status
            refused.value.close()
        assert orders == ["undo"]
    finally:
        page.close()


def test_a_device_that_falls_silent_is_told(tmp_path):
    with device(["press"], 1) as line:
        words = ("teach", url(line), tmp_path / "a", "--classes", "press", "--seconds", "7")
        done = run_program(*words)
    assert "no sample for 3 s: is the device plugged in?" in done.stdout


def tapped(live):  # for 0.1 s, which is looked at for 0.9 s
    values = NOISE * np.random.default_rng(0).normal(size=(700, 1, 6))
    values[400:410, 0, 2] += 4
    return ArraySource(wrench_spec(), cut_chunks(values, RATE_HZ), live)


def taught_tap(folder, source, say):
    teacher = Teacher(
        Lesson.begin(folder, FewShot(source.spec, np.float32(0.3 * NOISE))), ["tap"], 9
    )
    _teach(teacher, source, "", SimpleNamespace(listen=lambda: None, next=say))
    return teacher


def test_a_tap_keeps_its_name_where_the_next_is_named_before_it_is_over(tmp_path):
    source, due = tapped(live=False), ["press"]
    say = lambda: due.pop() if due and source.stats.delivered > 460 else ""  # noqa: E731
    teacher = taught_tap(tmp_path / "a", source, say)
    assert [one.label for one in teacher.lesson.touches] == ["tap"] and teacher.label == "press"


def test_a_device_is_read_while_a_touch_is_judged(tmp_path, monkeypatch):
    source, judge = tapped(live=True), Lesson.leave_one_out

    def judge_late(lesson):
        if lesson.touches:
            until(lambda: source.stats.delivered == 700, 10)
        return judge(lesson)

    monkeypatch.setattr(Lesson, "leave_one_out", judge_late)
    teacher = taught_tap(tmp_path / "a", source, lambda: "")
    assert [one.label for one in teacher.lesson.touches] == ["tap"]


def test_letters_and_numbers_are_orders(tmp_path):
    """A number chooses, n goes to the next, u takes back, q learns."""
    with device(["press"] * 2, 1, pace="realtime") as line:
        words = ("teach", url(line), tmp_path / "a", "--classes", "press,slide", "--touches", "9")
        done = run_program(*words, input="n\nrub\n7\nu\n1\nq\n")
    assert done.returncode == 2
    assert "too few to learn from: a class needs two touches" in done.stderr
    for said in ("touch it: slide (1 of 9)", "touch it: rub (1 of 9)",
                 "there is no class 7: there are 3", "there is no touch to take back"):  # fmt: skip
        assert said in done.stdout


PAGE = ROOT / "docs" / "how-to" / "teaching.md"
FIVE = ("press", "slide", "double", "push", "twist")


def test_the_tutorial_does_what_it_says(call, cwd):
    page = PAGE.read_text("utf-8")
    taught, decided, check, _, emulated, again, teapot, mug, met = re.findall(
        r"```sh\n(.*?)```", page, re.S
    )
    (table,) = re.findall(r"```toml[^\n]*\n(.*?)```", page, re.S)
    assert ",".join(FIVE) in taught
    with device([kind for kind in FIVE for _ in range(3)], 1) as line:
        command = taught.replace("serial:///dev/ttyUSB0?codec=bota", url(line))
        code, out, _ = call(*shlex.split(command)[1:], "--touches", "3")
    assert code == 0 and "knows press, slide, double, push, twist" in out
    with device(["slide"], 2, pace="realtime") as line:
        command = decided.replace("serial:///dev/ttyUSB0?codec=bota", url(line, "host"))
        code, out, _ = call(*shlex.split(command)[1:], "--seconds", "6")
    assert code == 0 and '"label":"slide"' in out.replace(" ", "")
    with start_program(*shlex.split(emulated)[1:], stderr=None) as there:
        assert "hand?codec=bota" in there.stdout.readline()
        code, out, _ = call(*shlex.split(again)[1:], "--seconds", "7")
        there.terminate()
    assert code == 0 and '"label":"press"' in out.replace(" ", "")
    (cwd / "robot.toml").write_text(table)
    assert call(*shlex.split(check)[1:])[0] == 0
    pytest.importorskip("numba")
    for command in (teapot, mug):
        assert call(*shlex.split(command)[1:])[0] == 0
    code, out, _ = call(*shlex.split(met)[1:])
    assert code == 0 and '"object":"teapot"' in out.replace(" ", "")
