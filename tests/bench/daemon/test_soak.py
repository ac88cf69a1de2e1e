"""The soak itself, for a moment, with faults that leave nothing out; and what it reckons with."""

import resource

import numpy as np
import pytest

from bench.daemon.accounts import RecordedSamples, account
from bench.daemon.latencies import latencies
from bench.daemon.soak import soak_records
from bench.daemon.soak_rig import soak
from bench.emulated import KINDS, Played
from tactile_rt.daemon.items import Opened, SourceChunk
from tactile_rt.drivers.emulation.faults import Fate
from tactile_rt.recording import Recording, recover
from tactile_rt.recording.reader import is_finished
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.recorder_by_hand import View, begun

MS = 1_000_000
MUST = ("unbalanced", "unexplained", "miscounted", "queues_unbalanced", "queues_dropped",
        "decisions_lost", "parts_broken", "unfinished", "tracebacks")  # fmt: skip


@pytest.mark.slow
@pytest.mark.alone
def test_under_faults_every_sample_is_delivered_or_counted():
    result = soak(10.0, every_s=0.45, first_s=1.5)
    struck = {kind for played in result.played.values() for kind, _, _ in played.faults}
    assert struck == {"can_error", *(fault.kind for fault in KINDS)}
    fates = np.concatenate([played.fate for played in result.played.values()])
    assert {Fate.CORRUPTED, Fate.DROPPED, Fate.UNHEARD, Fate.DUPLICATED} <= set(fates.tolist())
    records = soak_records(result)
    wrong = [(r.name, r.value, r.anchor, r.how) for r in records
             if r.name.endswith(MUST) and r.value != 0]  # fmt: skip
    assert wrong == []
    assert result.code == 0
    assert all(len(heard.t_ns) > 20 for heard in result.heard.values())
    pulled = sum(kind == "unplug" for p in result.played.values() for kind, _, _ in p.faults)
    assert sum("device:lost" in line for line in result.log.splitlines()) == pulled


def test_what_was_added_to_a_file_that_cannot_grow_counts_as_lost(tmp_path):
    spec, sent, view = small_spec(30), 200, View()
    recorder = begun(view, tmp_path / "a", min_free_mb=0)
    recorder.handle([Opened("a", spec, "synthetic:", ArraySource(spec, []), 1, 1)])
    values = np.random.default_rng(0).normal(size=(sent, *spec.shape))
    chunks = cut_chunks(values, spec.rate_hz, samples=1, start_ns=2)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for n, chunk in enumerate(chunks):
        recorder._flush_at = 0.0 if n % 10 == 9 else np.inf  # every tenth is followed by a flush
        if n == 100:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
        try:
            recorder.handle([SourceChunk("a", spec, chunk, int(chunk.t_ns[0]), 1)])
        finally:
            if n == 120:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    recorder.close()
    lost = recorder.details()["lost_samples"]
    found = []
    for k, path in enumerate(sorted((tmp_path / "a").glob("*.mcap"))):
        whole = path if is_finished(path) else recover(path, tmp_path / f"{k}.mcap")
        found += [int(number) for chunk in Recording(whole) for number in chunk.seq]
    assert 0 < lost < sent
    assert len(found) == len(set(found)) == sent - lost
    assert sum("File too large" in reason for _, reason, _ in view.told) == len(view.told)


def played(fate, **changed):
    n = len(fate)
    return Played(**{
        "fate": np.array(fate, np.uint8), "at_ns": 1 + MS * np.arange(n, dtype=np.int64),
        "duplicated": 0, "faults": (), **changed,
    })  # fmt: skip


def counts(**changed):
    none = dict.fromkeys(("delivered", "corrupt", "missing", "dropped", "duplicates"), 0)
    return none | changed


S, D, C, U = Fate.SENT, Fate.DROPPED, Fate.CORRUPTED, Fate.UNHEARD


@pytest.mark.parametrize(
    ("fate", "stats", "seq", "found"),
    [
        ([S, S, D, C, S], counts(delivered=3, corrupt=1, missing=1), [0, 1, 4], (0, 0, 0)),
        # what was sent last before the plug was pulled may be lost with it
        ([S, S, S, U, S], counts(delivered=3, missing=2), [0, 1, 4], (0, 0, 0)),
        # who opens a port throws away what is there
        ([S, U, S, S], counts(delivered=2, missing=2), [0, 3], (0, 0, 0)),
        # without that it is lost without a reason, though the sum is right
        ([S, S, S, D, S], counts(delivered=3, missing=2), [0, 1, 4], (0, 1, 0)),
        # neither counted nor delivered
        ([S, S, S, S, S], counts(delivered=4), [0, 1, 2, 4], (1, 1, 1)),
        # came, and is not recorded
        ([S, S, S], counts(delivered=3), [0, 1], (0, 1, 2)),
        # recorded twice, or never sent
        ([S, S, D], counts(delivered=3), [0, 1, 1], (0, 1, 1)),
        ([S, S, D], counts(delivered=3), [0, 1, 2], (0, 1, 0)),
        # counted as the wrong cause
        ([S, C, S], counts(delivered=2, missing=1), [0, 2], (0, 0, 1)),
    ],
)
def test_an_account_tells_what_does_not_add_up(fate, stats, seq, found):
    got = account("serial", played(fate), stats, np.array(seq, np.int64))
    assert (got.unbalanced, got.unexplained, got.miscounted) == found


def test_copies_that_were_on_the_line_when_the_plug_was_pulled_are_explained():
    fate = [S, Fate.DUPLICATED, S, U, S, Fate.DUPLICATED, S]
    stats = counts(delivered=4, missing=3, duplicates=2)
    got = account("serial", played(fate, duplicated=4), stats, np.array([0, 4, 5, 6]))
    assert (got.unbalanced, got.unexplained, got.miscounted) == (0, 0, 0)
    got = account("serial", played(fate, duplicated=4), counts(**stats) | {"duplicates": 1},
                  np.array([0, 4, 5, 6]))  # fmt: skip
    assert (got.unbalanced, got.miscounted) == (3, 3)


def test_a_latency_begins_with_the_write_of_the_sample_that_completes_the_step():
    n = 8000
    one = played([S] * n, faults=(("drop", 5.0, 0.5),))
    seq = np.delete(np.arange(n, dtype=np.int64), 4109)  # lost: the next one completes the step
    recorded = RecordedSamples(seq, 1 + 1000 + MS * seq)  # by its clock 1 us after it was written
    t_ns = np.array([500, 4000, 4100, 5200, 7000], np.int64) * MS
    at_ns = t_ns + np.array([10, 10, 12, 13, 14]) * MS + 1
    found = latencies(9 * MS, recorded, {"a": one}, "a", t_ns, at_ns)
    assert found.quiet.tolist() == [1, 2, 5]  # not what came before all had begun
    assert found.faulty.tolist() == [4]
    assert {k: v.tolist() for k, v in found.kinds.items()} == {"drop": [4.0]}
