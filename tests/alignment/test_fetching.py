"""What is needed of published sessions, read by ranges from a server on this machine."""

import hashlib
import re

import numpy as np
import pytest

from tactile_rt.alignment.clock import CLOCKS
from tactile_rt.alignment.datasets import fetching
from tactile_rt.alignment.datasets.fetching import PublishedFile, fetch, published_files
from tactile_rt.alignment.example import Brain
from tactile_rt.alignment.example_files import write_example
from tactile_rt.alignment.nwb import WINDOWS, read_session
from tactile_rt.core.errors import ConfigError
from tests.helpers.archive import Archive
from tests.helpers.refusals import refusal

h5py = pytest.importorskip("h5py", reason="h5py reads the files")

VOLTAGES = 4 << 20  # bytes that nothing needs


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Sessions of the published structure, voltages and whiskers' angles included."""
    folder = tmp_path_factory.mktemp("whole") / "brain"
    write_example(folder, Brain(mice=2, sessions=1, units=12, trials=6))
    files = sorted((folder / "recordings").rglob("*.nwb"))
    for path in files:
        with h5py.File(path, "r+") as file:
            (series,) = file["acquisition"].values()
            if "data" in series:
                del series["data"]
            noise = np.random.default_rng(0).integers(-99, 99, VOLTAGES // 2, dtype=np.int16)
            series["data"] = noise
    return files


@pytest.fixture
def archive(whole, tmp_path_factory, monkeypatch):
    """A list of the sessions on a server, and the server."""
    monkeypatch.setattr(fetching, "AGAIN", 1)
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with Archive(tmp_path_factory.mktemp("archive")) as server:
        listing = []
        for k, path in enumerate(whole):
            (server.folder / f"blob{k}").symlink_to(path)
            data = path.read_bytes()
            sha256, url = hashlib.sha256(data).hexdigest(), server.url(f"blob{k}")
            listing.append(PublishedFile(f"sub/{path.name}", len(data), sha256, url))
        yield listing, server


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("clock", CLOCKS)
def test_what_is_fetched_reads_as_the_whole_file_does(whole, archive, tmp_path, window, clock):
    listing, _ = archive
    fetch(listing, tmp_path / "small")
    for path in whole:
        expected = read_session(path, window, clock=clock)
        found = read_session(tmp_path / "small" / path.name, window, clock=clock)
        for name, value in vars(expected.session).items():
            np.testing.assert_array_equal(getattr(found.session, name), value)
        assert (found.notes, found.task) == (expected.notes, expected.task)
        np.testing.assert_array_equal(found.response.histogram, expected.response.histogram)


def test_voltages_stay_where_they_are(whole, archive, tmp_path):
    listing, server = archive
    new, transferred = fetch(listing, tmp_path)
    assert new == 2
    size = sum(file.size for file in listing)
    assert transferred < size - 1.8 * VOLTAGES
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) < transferred
    with h5py.File(tmp_path / whole[0].name) as file:
        assert file.attrs["source_sha256"] == listing[0].sha256
    # None is asked for twice.
    requests = server.requests()
    assert len(set(requests)) == len(requests)


def test_a_fetch_goes_on_where_it_broke_off(archive, tmp_path):
    listing, server = archive
    (server.folder / "blob1").unlink()
    with pytest.raises(ConfigError, match=r"sub/.* cannot be fetched: the server says 404"):
        fetch(listing, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [listing[0].name]
    server.forget()
    assert fetch([listing[0]], tmp_path) == (0, 0)
    assert server.requests() == []


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("gone", "the server says 404"),
        ("no ranges", "the server sends whole files, no ranges"),
        ("another size", r"it has \d+ bytes, and not \d+"),
        ("cut", "IncompleteRead"),
    ],
)
def test_what_a_server_does_wrong_is_one_line(archive, tmp_path, fault, said):
    listing, server = archive
    server.misbehave(fault)
    found = refusal(fetch, listing, tmp_path)
    assert re.search(said, found) and listing[0].path in found
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_is_busy_is_asked_again(archive, tmp_path):
    listing, server = archive
    server.misbehave("once busy")
    assert fetch(listing, tmp_path)[0] == 2


def test_no_server(tmp_path, monkeypatch):
    monkeypatch.setattr(fetching, "AGAIN", 0)
    file = PublishedFile("sub/a.nwb", 10, "", "http://127.0.0.1:9/a")
    with pytest.raises(ConfigError, match=r"sub/a.nwb cannot be fetched: .*refused"):
        fetch([file], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_is_no_session_is_one_line(archive, tmp_path):
    listing, server = archive
    (server.folder / "blob0").unlink()
    (server.folder / "blob0").write_bytes(bytes(listing[0].size))
    assert "cannot be fetched" in refusal(fetch, listing, tmp_path)


def test_a_file_is_read_as_from_a_disk(whole, archive):
    listing, _ = archive
    data = whole[0].read_bytes()
    remote = fetching.RangeFile(fetching.connections(), listing[0].url, len(data))
    rng = np.random.default_rng(0)
    for _ in range(40):
        begin, number = int(rng.integers(len(data))), int(rng.integers(3 * fetching.BLOCK))
        remote.seek(begin)
        assert remote.read(number) == data[begin : begin + number]
        assert remote.tell() == min(begin + number, len(data))
    assert remote.seek(-5, 2) == len(data) - 5 and remote.read() == data[-5:]
    assert remote.read(1) == b""


def test_the_command(archive, tmp_path, monkeypatch, call):
    listing, server = archive
    monkeypatch.setattr(fetching, "published_files", lambda name: tuple(listing))
    small = tmp_path / "small"
    code, out, _ = call("align", "fetch", "000231", "--list")
    assert code == 0 and [line.split()[1] for line in out.splitlines()] == [
        f.sha256 for f in listing
    ]
    code, _, err = call("align", "fetch", "000231", small, "--session", "mouse-01")
    assert code == 0 and "1 sessions (1 new), 1 mice, 12 units" in err and "WARNING" not in err
    code, _, err = call("align", "fetch", "000231", small)
    assert code == 0 and "2 sessions (1 new), 2 mice, 24 units" in err
    assert "WARNING: the published analysis is of 11 mice and 999 units" in err
    code, _, err = call("align", "build", small, "--out", tmp_path / "b.json", "--bootstraps", 5)
    assert (code, err.count("WARNING")) == (0, 0) and "spikes on the session's clock" in err, err
    server.misbehave("gone")
    for arguments, said in (
        (("000231", tmp_path / "other"), "the server says 404"),
        (("000231",), "name a folder"),
        (("000231", small, "--session", "none"), "none of 2 sessions matches none"),
        (("example", small), "example cannot be fetched"),
        (("00231", small), "did you mean 000231"),
    ):
        code, _, err = call("align", "fetch", *arguments)
        assert code == 2 and said in err and err.startswith("tactile-rt: "), err
        assert err.count("\n") == 1


def test_the_list_of_the_published_sessions():
    files = published_files("dandi_000231.csv")
    assert len(files) == len({f.name for f in files}) == 44
    assert len({f.path.partition("/")[0] for f in files}) == 11
    assert {f.path.partition("_")[0] for f in files if "231CR" in f.path} == {"sub-231CR/sub-231CR"}
    for file in files:
        assert re.fullmatch(
            r"sub-\w+/sub-\w+_ses-\d{8}T\d{6}_behavior\+ecephys\+image\.nwb", file.path
        )
        assert re.fullmatch(r"[0-9a-f]{64}", file.sha256) and file.size > 5e9
        assert file.url.startswith("https://dandiarchive.s3.amazonaws.com/blobs/")
        assert "?versionId=" in file.url
