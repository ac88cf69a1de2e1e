"""Recordings as LeRobot datasets: rows that lose nothing, and what LeRobot reads first.

LeRobot itself reads one in `bench/recording/lerobot_peer.py`.
"""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pyarrow.parquet as pq
import pytest

from tactile_rt.core.errors import ConfigError, RecordingError, SpecMismatch
from tactile_rt.core.stream import Chunk, concatenate
from tactile_rt.recording import Description, Recording
from tactile_rt.recording.as_lerobot import write_dataset
from tactile_rt.recording.lerobot_meta import Statistics, film_of
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.recordings import noise, write_as_daemon

SPEC = small_spec()


def odd_chunks(n=1000):
    """A second at 1 kHz with a gap, elements that are lost, and all kinds of NaN."""
    chunks = cut_chunks(noise(n), 1000.0, samples=9, start_ns=123_456_789)
    values, valid = chunks[1].values.copy(), chunks[1].valid.copy()
    values.view(np.uint32)[4, 2] = 0xFFC01234, 0x7F800001  # NaN that carry something
    values[0, 0], values[1, 1] = np.inf, -0.0
    valid[0, 0] = valid[5, 1] = False
    chunks[1] = replace(chunks[1], values=values, valid=valid)
    later = 300_000_000  # nine rows without a sample
    return [*chunks[:40], *(replace(c, seq=c.seq + 300, t_ns=c.t_ns + later) for c in chunks[40:])]


def write(path, chunks, spec=SPEC, **session):
    about = Description(spec, 1_700_000_000_123_456_789, "serial:x", session=session)
    return Recording(write_as_daemon(path, about, chunks))


def samples(folder, episode=0):
    """The samples of an episode's rows, without what fills the rows up."""
    count = column(folder, "tactile.count", episode)
    found = {n: column(folder, f"tactile.{n}", episode) for n in ("seq", "t_ns", "values", "valid")}
    if found["seq"].ndim == 1:  # an array of one number is that number
        return found
    used = np.arange(found["seq"].shape[1]) < count[:, None]
    return {name: padded[used] for name, padded in found.items()}


def check_samples(folder, recording, episode=0):
    whole = concatenate(list(recording))
    for name, found in samples(folder, episode).items():
        expected = getattr(whole, name)
        found = found.reshape(expected.shape).astype(expected.dtype)
        assert np.array_equal(found, expected, equal_nan=name == "values")


def table(folder, episode=0):
    return pq.read_table(folder / f"data/chunk-000/file-{episode:03d}.parquet")


def column(folder, name, episode=0):
    return np.array(table(folder, episode).column(f"observation.{name}").to_pylist())


@pytest.fixture
def recording(path):
    return write(path, odd_chunks())


def test_rows_hold_every_sample_and_say_of_what_array(recording, tmp_path):
    assert write_dataset([recording], tmp_path / "set") == 1000
    check_samples(tmp_path / "set", recording)
    about = json.loads((tmp_path / "set/meta/tactile_rt/episode-000000.json").read_text("utf-8"))
    made = Description.from_metadata("set", about["tactile_rt"], about["session"], False)
    assert made == recording.description


def test_a_row_has_every_sample_since_the_one_before_and_none_after_it(recording, tmp_path):
    write_dataset([recording], tmp_path / "set", fps=30)
    whole = concatenate(list(recording))
    count, t_ns = (column(tmp_path / "set", f"tactile.{n}") for n in ("count", "t_ns"))
    assert count.sum() == 1000 and count.max() == t_ns.shape[1] == 34
    assert (count[10:20] == 0).sum() >= 8
    begin = int(whole.t_ns[0])
    for k, (n, times) in enumerate(zip(count, t_ns, strict=True)):
        after = [Fraction(int(t) - begin, 10**9) for t in times[:n]]
        assert all(Fraction(k - 1, 30) < t <= Fraction(k, 30) for t in after)
        assert not times[n:].any()
    found = table(tmp_path / "set")
    stamps = np.array(found.column("timestamp"), np.float32)
    assert stamps.tolist() == (np.arange(len(count)) / 30).astype(np.float32).tolist()
    assert found.column("frame_index").to_pylist() == list(range(len(count)))


def test_the_state_is_the_newest_value_that_can_be_trusted(tmp_path):
    (chunk,) = cut_chunks(np.arange(60.0, dtype=np.float32).reshape(10, 3, 2), 25.0, samples=10)
    valid = chunk.valid.copy()
    valid[:2, 0] = valid[5:, 1] = False
    made = write(tmp_path / "x.mcap", [replace(chunk, valid=valid)])
    write_dataset([made], tmp_path / "set", fps=25)
    state = column(tmp_path / "set", "state").reshape(-1, 3, 2)
    assert len(state) == 10
    assert state[:, 0, 0].tolist() == [0, 0, *range(12, 60, 6)]  # nothing yet, then each
    assert state[:, 1, 0].tolist() == [*range(2, 32, 6), *[26] * 5]
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    assert names == ["A0.fy", "A0.mz", "A1.fy", "A1.mz", "A2.fy", "A2.mz"]


def test_what_lerobot_reads_first_is_there_and_agrees(recording, tmp_path):
    pandas = pytest.importorskip("pandas")
    other = write(tmp_path / "other.mcap", odd_chunks(500), task="stroke it")
    folder = tmp_path / "set"
    write_dataset([recording, other], folder, fps=50)
    info = json.loads((folder / "meta/info.json").read_text())
    rows = [len(table(folder, k)) for k in range(2)]
    assert info["codebase_version"] == "v3.0" and info["fps"] == 50
    assert (info["total_episodes"], info["total_frames"]) == (2, sum(rows))
    assert info["splits"] == {"train": "0:2"} and info["video_path"] is None
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.task_index.to_dict() == {"small": 0, "stroke it": 1}
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [e["length"] for e in episodes] == rows
    assert [e["dataset_from_index"] for e in episodes] == [0, rows[0]]
    assert [e["dataset_to_index"] for e in episodes] == [rows[0], sum(rows)]
    assert [e["tasks"] for e in episodes] == [["small"], ["stroke it"]]
    for k, e in enumerate(episodes):
        at = {name: e[f"data/{name}"] for name in ("chunk_index", "file_index")}
        found = pq.read_table(folder / info["data_path"].format(**at))
        assert set(found.column("episode_index").to_pylist()) == {k}
        rows_of = range(e["dataset_from_index"], e["dataset_to_index"])
        assert found.column("index").to_pylist() == list(rows_of)
        assert set(found.column("task_index").to_pylist()) == {k}
    for name, feature in info["features"].items():
        shape = feature["shape"] if feature["shape"] != [1] else []
        first = np.array(table(folder).column(name)[0].as_py())
        assert list(first.shape) == shape, name
    # Of both the widest row's arrays, so that rows go together.
    assert table(folder, 0).schema.equals(table(folder, 1).schema)
    check_samples(folder, other, episode=1)


def test_statistics_are_of_what_can_be_trusted(tmp_path):
    values = noise(700) * np.array([1, 1e-3], np.float32) + np.array([5, 0], np.float32)
    (chunk,) = cut_chunks(values, 1000.0, samples=700)
    valid = chunk.valid.copy()
    valid[::3, 1] = False
    broken = chunk.values.copy()
    broken[::3, 1] = 1e9
    other = replace(chunk, values=broken, valid=valid)
    made = [write(tmp_path / f"{k}.mcap", [c]) for k, c in enumerate((other, other))]
    write_dataset(made, tmp_path / "set")
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())["observation.tactile.values"]
    good = np.delete(values[:, 1], np.s_[::3], axis=0)
    for name, expected in (
        ("min", good.min(0)), ("max", good.max(0)), ("mean", good.mean(0)), ("std", good.std(0)),
        ("q10", np.quantile(good, 0.1, axis=0)), ("q99", np.quantile(good, 0.99, axis=0)),
    ):  # fmt: skip
        found = np.array(stats[name])
        assert found.shape == (34, 3, 2) and (found == found[0]).all()
        np.testing.assert_allclose(found[0, 1], expected, rtol=1e-4)
    assert stats["count"] == [1400]


def test_statistics_of_much_keep_little_and_of_nothing_are_zero():
    one = Statistics()
    rows = np.random.default_rng(3).normal(size=(60_000, 1)).astype(np.float32)
    for begin in range(0, len(rows), 7001):
        one.add(rows[begin : begin + 7001])
    found = one.compute()
    assert len(one._kept) <= 10_000
    assert one._every == 8 and np.array_equal(one._kept, rows[::8])
    np.testing.assert_allclose(found["q90"], np.quantile(rows[::8], 0.9))
    np.testing.assert_allclose(found["std"], rows.std(), rtol=1e-5)
    none = Statistics()
    none.add(np.full((3, 2), np.nan, np.float32))
    assert not any(v.any() for k, v in none.compute().items() if k != "count")


def test_samples_that_no_rows_can_hold_are_refused(tmp_path):
    (chunk,) = cut_chunks(noise(100), 1000.0, samples=100)
    away = replace(chunk, t_ns=chunk.t_ns + (2**60) * (np.arange(100) > 50))
    made = write(tmp_path / "x.mcap", [away])
    with pytest.raises(RecordingError, match=r"100 samples are spread over .* too unevenly"):
        write_dataset([made], tmp_path / "set")
    bunch = cut_chunks(noise(3000), 1000.0, samples=3000)[0]
    t_ns = np.where(np.arange(3000) < 2000, 0, 3600 * 10**9)
    with pytest.raises(RecordingError, match="too unevenly"):
        write_dataset([write(tmp_path / "y.mcap", [replace(bunch, t_ns=t_ns)])], tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_time_that_goes_back_keeps_the_order_of_samples(tmp_path):
    chunks = cut_chunks(noise(300), 1000.0, samples=100)
    chunks[1] = replace(chunks[1], t_ns=chunks[1].t_ns - 150_000_000)
    made = write(tmp_path / "x.mcap", chunks)
    write_dataset([made], tmp_path / "set")
    check_samples(tmp_path / "set", made)


def test_what_cannot_be_a_dataset_is_named(recording, tmp_path):
    other = write(tmp_path / "o.mcap", cut_chunks(noise(9, (2, 2)), 1000.0), small_spec(2))
    with pytest.raises(SpecMismatch, match=r"o\.mcap has another array"):
        write_dataset([recording, other], tmp_path / "set")
    with pytest.raises(RecordingError, match="has no samples"):
        write_dataset([write(tmp_path / "e.mcap", [])], tmp_path / "set")


def film(path, frames, fps=30):
    """Frame k is as bright as 2 k."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as made:
        stream = made.add_stream("libx264", rate=fps, options={"crf": "5"})
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        for k in range(frames):
            pixels = np.full((32, 48, 3), 2 * k, np.uint8)
            made.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        made.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("fps", "at", "expected"),
    [
        (30, "", lambda k: k),
        (30, "@0.5", lambda k: max(0, k - 15)),
        (30, "@-0.1", lambda k: min(99, k + 3)),
        (60, "", lambda k: min(99, 2 * k)),
        (10, "", lambda k: k // 3),
    ],
)
def test_each_row_shows_the_newest_frame_that_there_was(fps, at, expected, recording, tmp_path):
    av = pytest.importorskip("av")
    path = film(tmp_path / "front.mp4", 100, fps)
    write_dataset([recording], tmp_path / "set", films=[film_of(f"front={path}{at}")])
    key = "observation.images.front"
    made = tmp_path / f"set/videos/{key}/chunk-000/file-000.mp4"
    with av.open(str(made)) as video:
        seen = [(f.time, f.to_ndarray(format="rgb24").mean() / 2) for f in video.decode(video=0)]
    rows = len(table(tmp_path / "set"))
    assert [t for t, _ in seen] == pytest.approx([k / 30 for k in range(rows)])
    for k, (_, brightness) in enumerate(seen):
        assert brightness == pytest.approx(expected(k), abs=1.6)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"][key]["shape"] == [32, 48, 3] and "video_key" in info["video_path"]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())[key]
    assert np.array(stats["mean"]).shape == (3, 1, 1) and 0 < stats["mean"][0][0][0] < 1
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    (episode,) = episodes.to_pylist()
    assert episode[f"videos/{key}/to_timestamp"] == rows / 30


def test_what_is_no_film_is_named(recording, tmp_path):
    pytest.importorskip("av")
    (tmp_path / "no.mp4").write_bytes(b"no film")
    for text, said in (
        ("front", "NAME=FILE or NAME=FILE@SECONDS"),
        ("a/b=x.mp4", "NAME=FILE"),
        (f"front={tmp_path}/none.mp4", "no film"),
        (f"front={tmp_path}/no.mp4@1", "is no film"),
    ):
        with pytest.raises(ConfigError, match=said):
            film_of(text)
    one = film_of(f"front={film(tmp_path / 'a.mp4', 3)}")
    with pytest.raises(ConfigError, match="films need a single recording"):
        write_dataset([recording, recording], tmp_path / "set", films=[one])


def test_a_chunk_of_one_sample_is_a_dataset(tmp_path):
    chunk = Chunk(np.array([7]), np.array([-5]), noise(1), np.zeros((1, 3), np.bool_))
    made = write(tmp_path / "x.mcap", [chunk])
    assert write_dataset([made], tmp_path / "set") == 1
    check_samples(tmp_path / "set", made)
