"""A queue that never holds up whoever puts, and whose counts add up."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.bounded_queue import BoundedQueue
from tests.helpers.waiting import PATIENCE_S, until

KINDS = ("a", "b")

pytestmark = pytest.mark.usefixtures("no_thread_left")


def queue(items=4, size=100, **further):
    """A queue of (kind, count, bytes); what is of no kind is left out."""
    return BoundedQueue(items, size, measure=lambda x: x if x[0] else None, kinds=KINDS, **further)


def started(call):
    made = threading.Thread(target=call)
    made.start()
    return made


ITEMS = st.tuples(st.sampled_from(KINDS), st.integers(1, 9), st.integers(0, 60))
STEPS = st.lists(st.one_of(ITEMS, st.sampled_from(["get", "take", "close"])), max_size=40)


@given(items=st.integers(1, 5), size=st.integers(1, 100), steps=STEPS)
def test_whatever_is_done_the_newest_wait_in_order_and_all_is_counted(items, size, steps):
    made, waiting, open_ = queue(items, size), [], True
    put, taken = dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0)

    def took(item):
        taken[item[0]] += item[1]
        return item

    for step in steps:
        if step == "get":
            expected = took(waiting.pop(0)) if waiting else None
            assert made.get(0) == expected
        elif step == "take":
            assert made.take(0) == [took(item) for item in waiting]
            waiting = []
        elif step == "close":
            open_ = False
            made.close()
        else:
            made.put(step)
            put[step[0]] += step[1]
            if open_:
                waiting.append(step)
                while len(waiting) > items or (sum(i[2] for i in waiting) > size and waiting[1:]):
                    waiting.pop(0)
        state = made.state
        assert (state.put, state.taken) == (put, taken)
        assert state.waiting == {k: sum(i[1] for i in waiting if i[0] == k) for k in KINDS}
        assert state.waiting_bytes == sum(i[2] for i in waiting)
        for kind in KINDS:
            assert put[kind] == taken[kind] + state.dropped[kind] + state.waiting[kind]
        assert made.dropped == state.dropped
        assert waiting or state.oldest_s == 0.0


def test_what_is_left_out_is_not_counted():
    made = queue()
    made.put(("", 1, 1))
    assert made.state.put == dict.fromkeys(KINDS, 0)
    assert made.take(0) == []


def test_a_plain_one_counts_items():
    made = BoundedQueue(2)
    for item in "xyz":
        made.put(item)
    assert made.dropped == {"items": 1}
    assert [made.get(), made.get(), made.get(0)] == ["y", "z", None]


@pytest.mark.parametrize("way", ["get", "take"])
def test_a_reader_is_woken_by_an_item_and_by_the_end(way):
    made, found = queue(), []
    reader = started(lambda: found.append(getattr(made, way)()))
    until(lambda: made._waiting)
    made.put(("a", 1, 1))
    reader.join(PATIENCE_S)
    assert found == [("a", 1, 1)] or found == [[("a", 1, 1)]]
    reader = started(lambda: found.append(getattr(made, way)()))
    until(lambda: made._waiting)
    made.close()
    reader.join(PATIENCE_S)
    assert not found[1]
    assert made.closed


def test_gathering_ends_with_what_is_urgent_and_when_it_is_half_full():
    for last in (("b", 1, 0), ("a", 1, 0)):
        made = queue(8, gather_s=1000.0, urgent=("b",))
        found = []
        reader = started(lambda made=made, found=found: found.extend(made.take()))
        for _ in range(3):
            made.put(("a", 1, 0))
        until(lambda made=made: made._waiting)
        assert not found
        made.put(last)
        reader.join(PATIENCE_S)
        assert len(found) == 4


@pytest.mark.parametrize("full", ["items", "bytes"])
def test_room_is_made_by_a_reader_and_nobody_waits_for_a_closed_one(full):
    made = queue(4, 100)
    for _ in range(4):
        made.put(("a", 1, 25 if full == "bytes" else 0))
    waited = started(lambda: made.wait_for_room(1000.0))
    until(lambda: made._waiting)
    made.get()
    assert waited.is_alive()
    made.get()
    waited.join(PATIENCE_S)
    assert not waited.is_alive()
    for wake in (made.take, made.close):
        for _ in range(4):
            made.put(("a", 1, 25))
        made.wait_for_room(0.0)
        waited = started(lambda: made.wait_for_room(1000.0))
        until(lambda: made._waiting)
        wake()
        waited.join(PATIENCE_S)
        assert not waited.is_alive()


def test_closed_it_may_drop_what_waits():
    made = queue()
    made.put(("a", 3, 1))
    made.close(drop=True)
    assert made.get() is None
    assert made.dropped["a"] == 3
    made.put(("b", 2, 1))
    assert made.dropped["b"] == 2


def test_its_counts_are_told_also_while_a_thread_hangs_in_it(monkeypatch):
    monkeypatch.setattr("tactile_rt.core.bounded_queue.LOOK_S", 0.01)
    made = queue()
    made.put(("a", 3, 1))
    seen = made.state
    with made._lock:
        assert made.state == seen


def test_many_writers_and_a_reader_lose_nothing_that_is_not_counted():
    made, found = queue(16, 10**6), []

    def read():
        while (item := made.get()) is not None:
            found.append(item)

    reader = started(read)
    writers = [started(lambda: [made.put(("a", 2, 1)) for _ in range(500)]) for _ in range(4)]
    for thread in writers:
        thread.join()
    made.close()
    reader.join()
    assert 2 * len(found) == made.state.taken["a"]
    assert made.state.taken["a"] + made.dropped["a"] == 4000


@pytest.mark.parametrize("way", ["got", "dropped"])
def test_an_urgent_one_that_is_gone_lets_others_come_together_again(way):
    made, items = queue(items=9, size=100, urgent=("b",), gather_s=PATIENCE_S), []
    made.put(("b", 1, 60))
    if way == "got":
        made.get(0)
    made.put(("a", 1, 60))  # there is no room for both
    reader = started(lambda: items.extend(made.take(PATIENCE_S)))
    until(lambda: made._waiting or items)
    made.put(("b", 1, 20))
    reader.join(PATIENCE_S)
    assert items == [("a", 1, 60), ("b", 1, 20)]


def test_without_a_reason_nothing_is_gathered(monkeypatch):
    made = BoundedQueue()
    made.put("x")
    monkeypatch.setattr(made, "_wait", lambda *_: pytest.fail("it waits"))
    assert made.take() == ["x"]


def test_plain_items_have_no_size():
    made = BoundedQueue(size=1)
    for k in range(5):
        made.put(k)
    assert made.state.waiting_bytes == 0 and made.take() == list(range(5))
