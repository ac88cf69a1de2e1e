"""`tactile-rt replay`: the daemon's decisions again at every speed, and the first that differs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.recording import Recording
from tactile_rt.recording.writer import McapFile
from tactile_rt.testing import FakeSerial, small_spec
from tests.helpers.daemons import load_checked, running_daemon
from tests.helpers.waiting import until

tiny_model = pytest.importorskip("tests.helpers.tiny_model")

SPEC = small_spec()
TOPICS = ("samples", "wire", "health", "decisions", "events")


def touching(n, seed=0):
    """(n, 3, 2): rest for half a second, then touches of different force."""
    t = np.arange(n) / 1000.0
    noise = np.random.default_rng(seed).normal(scale=1e-3, size=(n, 3, 2))
    on = (t > 0.5) & (t % 0.7 < 0.3)
    size = 0.05 * (1 + np.floor(t / 0.7))
    return (noise + (size * on)[:, None, None]).astype(np.float32)


def daemon_records(folder, text, n=1800):
    """The files that a daemon records of an emulated device, in their order."""
    model = tiny_model.write_model(folder / "tiny.onnx")
    with FakeSerial(touching(n), spec=SPEC) as fake:
        loaded = load_checked(
            folder,
            # On a busy machine nothing is dropped, and no step skipped.
            f'version = 1\n[[source]]\nname = "left"\nurl = "{fake.url}&clock=device"\n'
            '[log]\nfile = "log"\n[limits]\nmodel_queue_items = 10000\nqueue_items = 100000\n'
            "queue_mb = 512\nstop_s = 60\n"
            + text.format(model=model).replace("[[model]]\n", '[[model]]\ncatch_up = "all"\n'),
        )
        with running_daemon(loaded) as daemon:
            until(lambda: all(m.queue.taken["samples"] == n for m in daemon.snapshot().models))
            until(lambda: all(m.final >= n // 700 for m in daemon.snapshot().models))
    return sorted((folder / "rec").glob("*.mcap"), key=lambda p: p.stat().st_mtime_ns)


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """(recording, model) of a daemon with two models on one source."""
    folder = tmp_path_factory.mktemp("live")
    (path,) = daemon_records(
        folder,
        '[[model]]\nfile = "{model}"\n'
        '[[model]]\nname = "last"\nfile = "{model}"\ndecisions = "final"\nmode = "sliding"\n'
        '[recorder]\nfolder = "rec"\nmin_free_mb = 0\n',
    )
    return path, folder / "tiny.onnx"


def again(path, to, change=lambda raw: raw, **session):
    """The recording once more, with other messages or notes; a note of None is left out."""
    about = Recording(path).description
    notes = {k: v for k, v in {**about.session, **session}.items() if v is not None}
    with to.open("wb") as file:
        made = McapFile(file, replace(about, session=notes))
        for raw in filter(None, map(change, Recording(path).raw(*TOPICS))):
            made.add(raw.topic, raw.data, raw.t_ns)
        made.finish()
    return to


def spoil(nth, **fields):
    """Change the nth decision of the model "left", from 0."""
    seen = []

    def change(raw):
        if raw.topic != "decisions" or b'"model":"left"' not in raw.data:
            return raw
        seen.append(raw)
        if len(seen) != nth + 1:
            return raw
        if not fields:
            return None
        return replace(raw, data=json.dumps({**json.loads(raw.data), **fields}).encode())

    return change


def test_it_decides_as_the_daemon_did_at_every_speed(call, done, live, tmp_path):
    path, _ = live
    recorded = [d for d in Recording(path).decisions() if d["model"] == "left"]
    assert len(recorded) >= 8
    timing = {"model_ms", "latency_ms", "age_ms", "late", "utc_ns"}
    printed = set()
    for speed in ("max", "max", "4"):
        out, err = done("replay", path, "--name", "left", "--speed", speed)
        assert err.startswith("1800 samples, ")
        printed.add(out)
    assert len(printed) == 1
    lines = [json.loads(line) for line in out.splitlines()]
    for mine, theirs in zip(lines, recorded, strict=False):
        assert {k: v for k, v in mine.items() if k != "utc_ns"} == {
            k: v for k, v in theirs.items() if k not in timing
        }
        assert abs(mine["utc_ns"] - theirs["utc_ns"]) < 1e8
    assert len(lines) - len(recorded) in range(3)  # what was decided as the stream ended
    to = tmp_path / "decisions.jsonl"
    assert call("replay", path, "--name", "left", "--out", to)[:2] == (0, "")
    assert to.read_text() == out
    assert call("replay", path, "--name", "left", "--out", to)[0] == 2


@pytest.mark.parametrize("name", ["left", "last"])
@pytest.mark.parametrize("further", [(), ("--codec", "recorded")])
def test_a_check_passes(name, further, call, done, live):
    path, model = live
    n = sum(d["model"] == name for d in Recording(path).decisions())
    out, _ = done("replay", path, "--check", "--name", name, *further)
    assert out.startswith(f"{n} decisions of {name} are as recorded")
    assert call("replay", path, "--check", "--name", name, "--model", model)[0] == 0


@pytest.mark.parametrize(
    ("nth", "fields", "said"),
    [
        (4, {"label": "other"}, "label was 'other', is '"),
        (0, {"step": 3}, "step was 3, is 1"),
        (2, {}, r"decision 3 "),
        (5, {"probabilities": {"a": 1.0}}, "classes were a, are nothing, steps"),
    ],
)
def test_a_check_names_the_first_difference(nth, fields, said, call, live, tmp_path):
    path = again(live[0], tmp_path / "x.mcap", spoil(nth, **fields))
    code, out, err = call("replay", path, "--check", "--name", "left")
    assert code == 1
    assert out.startswith(f"{nth} decisions of left are as recorded")
    assert said in err
    assert f"decision {nth + 1} " in err


def test_a_check_needs_the_model_that_decided(call, refused, live, tmp_path):
    path, model = live
    other = tiny_model.write_model(tmp_path / "other.onnx", temperature=2.0)
    (key,) = (k for k in Recording(path).description.session if k.endswith(".left"))
    known = again(path, tmp_path / "known.mcap", **{key: f"{model} sha256:{'0' * 64}"})
    for arguments in (("--model", model), ("--model", other)):
        said = refused("replay", known, "--check", "--name", "left", *arguments)
        assert "needs the model that decided, sha256 0000000000000000" in said
    said = refused("replay", known, "--name", "left")
    assert "no longer exists: name one by --model" in said
    moved = again(path, tmp_path / "moved.mcap", **{key: "/gone/tiny.onnx sha256:"})
    said = refused("replay", moved, "--name", "left")
    assert "/gone/tiny.onnx (sha256 unknown), no longer exists" in said
    # another model is what a replay is for, as long as it is not to be the same
    mine = call("replay", path, "--name", "left")
    others = call("replay", path, "--name", "left", "--model", other)
    assert mine[0] == others[0] == 0
    assert mine[1] != others[1]
    assert mine[1].count("\n") == others[1].count("\n")


def test_rotated_files_are_one_stream(call, done, tmp_path):
    paths = daemon_records(
        tmp_path,
        '[[model]]\nfile = "{model}"\n[recorder]\nfolder = "rec"\nmin_free_mb = 0\nrotate_s = 1\n',
        n=2400,
    )
    assert len(paths) > 1
    out, _ = done("replay", *paths[::-1], "--check")
    n = sum(1 for path in paths for _ in Recording(path).decisions())
    assert out.startswith(f"{n} decisions of left are as recorded")
    assert call("replay", *paths, "--codec", "recorded")[0] == 2


def test_a_file_of_late_decisions_comes_after_that_of_their_samples(done, live, tmp_path):
    decisions = list(Recording(live[0]).raw("decisions"))

    def early(raw):
        return raw if raw.topic != "decisions" or raw == decisions[0] else None

    files = [
        again(live[0], tmp_path / "late.mcap", lambda raw: raw if raw in decisions[1:] else None),
        again(live[0], tmp_path / "early.mcap", early),
    ]
    out, _ = done("replay", *files, "--check", "--name", "left")
    assert " decisions of left are as recorded" in out


def test_a_piece_of_a_stream_is_named_as_that(call, live, tmp_path):
    whole = Recording(live[0])
    touched_ns = next(d["t_ns"] for d in whole.decisions() if d["step"] == 3)
    came = next(
        raw.t_ns
        for raw, chunk in zip(whole.raw("samples"), whole, strict=True)
        if chunk.t_ns[0] > touched_ns
    )
    piece = again(live[0], tmp_path / "x.mcap", lambda raw: raw if raw.t_ns >= came else None)
    code, _, err = call("replay", piece, "--check", "--name", "left")
    assert code == 1
    assert "begins in the middle of its stream (sample " in err


def test_a_folder_and_several_sources_are_named(refused, live, tmp_path):
    again(live[0], tmp_path / "left.mcap")
    again(live[0], tmp_path / "right.mcap", daemon_source="right")
    said = refused("replay", tmp_path)
    assert "recordings of left (left.mcap ...), right (right.mcap ...)" in said
    said = refused("replay", tmp_path / "left.mcap", tmp_path / "right.mcap")
    assert "recordings of several sources: left, right" in said


def test_what_another_codec_makes_of_the_packets_is_told(call, tmp_path):
    path = tmp_path / "ascii.mcap"
    values = np.arange(1, 81, dtype=np.float32).reshape(40, 1, 2) / 64
    columns = "A0.fx:N,A0.fy:N"
    with FakeSerial(values, "ascii_line", options={"columns": columns}) as fake:
        call("record", f"{fake.url}", path, "--seconds", "1.5")
    n = sum(map(len, Recording(path)))
    assert n == 40
    model = tiny_model.write_model(tmp_path / "tiny.onnx")

    def told(*arguments):
        return call("replay", path, "--model", model, *arguments)[2]

    same = told("--codec", "recorded")
    assert f"{n} samples recorded, {n} decoded: {n} are the same, bit for bit, 0 differ" in same
    twice = told("--codec", "ascii_line?columns=A0.fx*2:N,A0.fy:N")
    assert "0 are the same, bit for bit, 40 differ, 0 were recorded alone" in twice
    assert "they differ by at most fx 1.23 N" in twice  # 79 / 64
    assert "fy" not in twice.splitlines()[1]
    assert "another array: " in told("--codec", "ascii_line?columns=B0.fx:N,B0.fy:N")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("{path}",), "several models decided live: choose by --name left, last"),
        (("{path}", "--name", "best"), "no model 'best' decided live; there are left, last"),
        (
            ("{path}", "--speed", "fast"),
            "--speed must be max or a multiple of the recorded pace, not 'fast'",
        ),
        (("{path}", "--name", "left", "--model", "x.onnx"), "model x.onnx cannot be read"),
        (("{path}", "--name", "left", "--codec", "natve"), "did you mean native?"),
        (("{path}", "--codec", "native?speed=3"), "are not options of a codec"),
    ],
)
def test_a_mistake_is_one_line(arguments, said, refused, live):
    assert said in refused("replay", *(a.format(path=live[0]) for a in arguments))


def test_without_a_daemon_there_is_nothing_to_check(call, refused, tmp_path):
    path = tmp_path / "run.mcap"
    call("record", "synthetic:2x3?pace=fast&seconds=0.3", path)
    said = refused("replay", path, "--check")
    assert "nothing to check: no model decided while it was recorded" in said
