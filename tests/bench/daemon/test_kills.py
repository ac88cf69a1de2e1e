"""`kill -9` of the daemon's process while it records; how much is lost, `bench daemon` measures."""

import pytest

from tests.helpers.waiting import until

pytest.importorskip("mcap")
kills = pytest.importorskip("bench.daemon.kills")


def on_disk(folder):
    return sum(path.stat().st_size for path in folder.glob("*.mcap"))


@pytest.mark.parametrize("rotate_s", [0, 1])
def test_what_was_written_is_recovered_and_others_can_read_it(rotate_s, tmp_path):
    noted = []

    def moment(daemon):
        """So much was taken, and then the disk was written to twice."""
        taken = 0
        while taken < 700:
            consumers = {c["kind"]: c for c in daemon.state()["consumers"]}
            taken = consumers["recorder"]["queue"]["taken"]["samples"]
        noted.append(taken)
        for _ in range(2):
            before = on_disk(tmp_path / "recordings")
            until(lambda before=before: on_disk(tmp_path / "recordings") != before)

    killed = kills.killed_once(tmp_path, moment, rotate_s)
    assert killed.cut == 1 or rotate_s  # it may hit between two files
    assert (killed.unreadable, killed.wrong, killed.missing) == (0, 0, 0)
    assert killed.samples >= noted[0]
