"""The account of what of a source is on the disk, over all of its files."""

from dataclasses import dataclass, field
from types import SimpleNamespace

from tactile_rt.daemon.ledger import Ledger
from tactile_rt.recording.writer import Extent


@dataclass(eq=False)
class File:
    """What a ledger asks of a file that is written."""

    samples: int
    flushed: Extent
    synced: Extent
    done: bool = False
    failed: OSError | None = None
    unsynced_ns: int = 0
    disowned: list = field(default_factory=list)

    @property
    def stats(self):
        return SimpleNamespace(samples=self.samples)

    def disown(self, kept):
        self.disowned.append(kept)
        return self.samples - kept.samples, 0


def at(samples, newest_ns):
    return Extent(samples, 0, newest_ns)


def told(ledger):
    return ledger.on_disk(open=True, meant_ns=5, slow_s=2.0)


def test_all_files_count_and_those_that_are_done_are_let_go():
    ledger, first, second = Ledger(), File(7, at(7, 70), at(4, 40)), File(3, at(2, 90), at(0, 0))
    ledger.begin(first)
    ledger.begin(second)
    for done in (False, True):
        first.done = done
        assert ledger.settle() == []
        disk = told(ledger)
        assert (disk.samples, disk.written_ns, disk.synced_ns) == (10, 90, 40)
    first.samples = 1000  # nobody asks it any more
    assert told(ledger).samples == 10
    second.samples = 5
    assert told(ledger).samples == 12


def test_what_waits_longest_for_the_medium_is_told():
    ledger = Ledger()
    for since in (0, 50, 30):
        ledger.begin(File(1, at(1, 1), at(0, 0), unsynced_ns=since))
    assert told(ledger).waits_ns == 30


def test_what_a_failed_sync_lost_is_handed_to_whoever_counts_it_once():
    ledger = Ledger()
    bad = File(9, at(9, 90), at(6, 60), done=True, failed=OSError("gone"))
    ledger.begin(bad)
    assert ledger.settle() == [(bad, 3, 0)] and bad.disowned == [at(6, 60)]
    assert ledger.settle() == []


def test_losses_add_up_and_none_is_no_loss():
    ledger = Ledger()
    ledger.lose(0, "nothing")
    assert told(ledger).lost_ns == 0
    ledger.lose(3, "no room")
    first = told(ledger)
    ledger.lose(4, "no folder")
    assert (first.lost_samples, first.lost_why) == (3, "no room") and first.lost_ns > 0
    assert (told(ledger).lost_samples, told(ledger).lost_why) == (7, "no folder")
    assert told(ledger).lost_ns >= first.lost_ns
