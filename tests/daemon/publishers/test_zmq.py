"""The ZeroMQ publisher against a real subscriber."""

import json

import pytest
import zmq

from tactile_rt.core.errors import SourceError
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.publishers.zmq import ZmqOptions, ZmqPublisher
from tactile_rt.testing import small_spec
from tests.helpers.published import (
    View,
    busy_snapshot,
    contact,
    decision,
    event,
    opened,
    running,
    samples,
)
from tests.helpers.waiting import PATIENCE_S, until

FREE = "tcp://127.0.0.1:*"
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def subscribe():
    """Connect subscribers; they are closed after, whatever becomes of the test."""
    context, sockets = zmq.Context(), []

    def connect(publisher, topic=b"", **options):
        socket = context.socket(zmq.SUB)
        sockets.append(socket)  # one that is let go of before it is closed warns
        socket.set(zmq.RCVTIMEO, round(1000 * PATIENCE_S))
        for name, value in options.items():
            socket.set(getattr(zmq, name), value)
        socket.subscribe(topic)
        socket.connect(publisher.details()["endpoint"])
        return socket

    yield connect
    for socket in sockets:
        socket.close(linger=0)
    context.term()


def settle(publisher, *sockets):
    """A subscription takes a moment to arrive: say something until all hear it; then say that this
    was it, as some of what was said may still be on its way."""
    for socket in sockets:
        until(lambda one=socket: publisher.handle([event(state="probe")]) or one.poll(10))
    publisher.handle([event(state="settled")])
    for socket in sockets:
        while json.loads(socket.recv_multipart()[1])["state"] != "settled":
            pass


@pytest.mark.usefixtures("still_clock")
def test_each_message_comes_with_its_topic_and_as_it_is(subscribe):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, samples=True, state_s=0, prefix="r/t"))
    items = [
        opened(), decision(), contact(), samples(small_spec(), [[1, 2]] * 3), event(), decision("b")
    ]  # fmt: skip
    with running(publisher) as view:
        socket = subscribe(publisher)
        settle(publisher, socket)
        publisher.handle(items)
        found = [socket.recv_multipart() for _ in items]
        socket.close()
    assert [topic.decode() for topic, _ in found] == [
        "r/t/whiskers/array", "r/t/whiskers/decision", "r/t/whiskers/contact",
        "r/t/whiskers/samples", "r/t/health", "r/t/whiskers/decision",
    ]  # fmt: skip
    assert [data for _, data in found] == [encode(message_of(item)) for item in items]
    said = json.loads(found[1][1])
    assert said["probabilities"] == {"duck": 0.25, "mug": 0.75} and said["frame"] == "mount"
    assert publisher.details()["dropped"] == 0 and view.reports == []


def test_a_subscriber_chooses_by_topic_and_one_that_comes_late_learns_of_the_array(subscribe):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, state_s=0.001))
    with running(publisher, View(small_spec(), busy_snapshot())):
        socket = subscribe(publisher, b"tactile/state")
        until(lambda: publisher.handle([]) or socket.poll(10))
        topic, state = socket.recv_multipart()
        socket.close()
        late = subscribe(publisher, b"tactile/whiskers/")
        until(lambda: publisher.handle([event()]) or late.poll(10))
        topics = {topic, late.recv_multipart()[0]}
        late.close()
    assert topics == {b"tactile/state", b"tactile/whiskers/array"}
    assert json.loads(state)["snapshot"]["consumers"][0]["kind"] == "zmq"


def test_a_slow_subscriber_is_dropped_for_and_counted_and_a_quick_one_gets_all(subscribe):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, queue=16, state_s=0))
    fat = "x" * 500_000
    with running(publisher):
        quick = subscribe(publisher)
        slow = subscribe(publisher, RCVHWM=1, RCVBUF=4096)
        settle(publisher, quick, slow)
        # From now on not read: what the system buffers is soon full, and then the publisher's own
        # queue for it. The quick one's holds one message at a time.
        seen, end = 0, None
        while end is None or seen < end:
            publisher.handle([event(reason=f"{seen} {fat}")])
            assert json.loads(quick.recv_multipart()[1])["reason"].startswith(f"{seen} ")
            seen += 1
            if end is None and publisher.details()["dropped"]:
                end = seen + 20  # the quick one goes on getting all
            assert seen < 1000
        dropped = publisher.details()["dropped"]
    assert 0 < dropped < seen


def test_without_anyone_and_after_all_have_gone_it_goes_on(subscribe):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, queue=2))
    with running(publisher):
        publisher.handle([event()] * 500)
        assert publisher.details()["messages"] >= 500
        socket = subscribe(publisher)
        settle(publisher, socket)
        socket.close()

        def dropped():
            before = publisher.details()["dropped"]
            publisher.handle([event()] * 500)
            return publisher.details()["dropped"] - before

        until(lambda: dropped() == 0)  # once it is known that it has gone


def test_a_port_that_is_taken_is_named_and_free_again_after_close():
    first = ZmqPublisher("zmq", ZmqOptions(bind=FREE))
    with running(first):
        taken = first.details()["endpoint"]
        second = ZmqPublisher("zmq", ZmqOptions(bind=taken))
        with pytest.raises(SourceError, match=f"cannot listen at {taken}: Address already in use"):
            second.open(View())
        second.close()
    with running(second):
        second.handle([event()])


def test_others_can_read_along_only_if_asked_and_then_it_is_told():
    assert ZmqOptions().bind.startswith("tcp://127.0.0.1:")
    with running(ZmqPublisher("z", ZmqOptions(bind="tcp://0.0.0.0:*"))) as view:
        assert view.reports == [("publisher.z", "exposed", "warning")]
