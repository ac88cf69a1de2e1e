"""`kill -9` of the daemon's process while it records; how much is lost, `bench daemon` measures."""

import pytest

from tests.helpers.waiting import until

kills = pytest.importorskip("bench.daemon.kills")


def recorder_of(daemon):
    (found,) = (c for c in daemon.state()["consumers"] if c["kind"] == "recorder")
    return found


@pytest.mark.parametrize("rotate_s", [0, 1])
def test_what_was_written_is_recovered_and_others_can_read_it(rotate_s, tmp_path):
    noted = []

    def moment(daemon):
        """So much was taken, and then, by its own account, it flushed twice."""
        while (state := recorder_of(daemon))["queue"]["taken"]["samples"] < 700:
            pass
        noted.append(state["queue"]["taken"]["samples"])
        sizes = [state["details"]["megabytes"]]

        def flushed_twice():
            size = recorder_of(daemon)["details"]["megabytes"]
            if size > sizes[-1]:  # which it is not for a moment between two files
                sizes.append(size)
            return len(sizes) > 2

        until(flushed_twice)

    killed = kills.killed_once(tmp_path, moment, rotate_s)
    assert killed.cut == 1 or rotate_s  # it may hit between two files
    assert (killed.unreadable, killed.wrong, killed.missing) == (0, 0, 0)
    assert killed.samples >= noted[0]
