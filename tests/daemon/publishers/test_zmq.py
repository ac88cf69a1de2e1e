"""The ZeroMQ publisher against a real subscriber."""

import json

import msgspec
import pytest
import zmq

from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.publishers.zmq import ZmqOptions, ZmqPublisher
from tactile_rt.stream import SourceError
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
from tests.helpers.waiting import until

FREE = "tcp://127.0.0.1:*"
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def context():
    with zmq.Context() as made:
        yield made


def subscriber(context, publisher, topic=b"", **options):
    """Connected, and known to the publisher."""
    socket = context.socket(zmq.SUB)
    socket.set(zmq.LINGER, 0)
    socket.set(zmq.RCVTIMEO, 20_000)
    for name, value in options.items():
        socket.set(getattr(zmq, name), value)
    socket.subscribe(topic)
    socket.connect(publisher.details()["endpoint"])
    return socket


def settle(publisher, socket, view):
    """A subscription takes a moment to arrive: say something until it is heard."""
    until(lambda: publisher.handle([event(state="probe")]) or socket.poll(10))
    until(lambda: not (socket.poll(50) and socket.recv_multipart()))


def test_each_message_comes_with_its_topic_and_as_it_is(context):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, samples=True, state_s=0, prefix="r/t"))
    items = [
        opened(), decision(), contact(), samples(small_spec(), [[1, 2]] * 3), event(), decision("b")
    ]  # fmt: skip
    with running(publisher) as view:
        socket = subscriber(context, publisher)
        settle(publisher, socket, view)
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


def test_a_subscriber_chooses_by_topic_and_one_that_comes_late_learns_of_the_array(context):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, state_s=0.001))
    with running(publisher, View(small_spec(), busy_snapshot())):
        socket = subscriber(context, publisher, b"tactile/state")
        until(lambda: publisher.handle([]) or socket.poll(10))
        topic, state = socket.recv_multipart()
        socket.close()
        late = subscriber(context, publisher, b"tactile/whiskers/")
        until(lambda: publisher.handle([event()]) or late.poll(10))
        topics = {topic, late.recv_multipart()[0]}
        late.close()
    assert topics == {b"tactile/state", b"tactile/whiskers/array"}
    assert json.loads(state)["snapshot"]["consumers"][0]["kind"] == "zmq"


def test_a_slow_subscriber_is_dropped_for_and_counted_and_a_quick_one_gets_all(context):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, queue=4, state_s=0))
    fat = 200_000
    with running(publisher) as view:
        quick = subscriber(context, publisher)
        settle(publisher, quick, view)
        # Not read: what the system buffers is soon full, and then the publisher's own queue.
        slow = subscriber(context, publisher, RCVHWM=1, RCVBUF=4096)
        until(lambda: publisher.handle([event(state="probe")]) or slow.poll(10))
        until(lambda: not (quick.poll(50) and quick.recv_multipart()))
        got = []
        for n in range(150):
            publisher.handle([event(reason=f"{n} " + "x" * fat)])
            got.append(int(json.loads(quick.recv_multipart()[1])["reason"].split()[0]))
        dropped = publisher.details()["dropped"]
        slow.close()
        quick.close()
    assert got == list(range(150))
    assert 0 < dropped < 150


def test_without_anyone_and_after_all_have_gone_it_goes_on(context):
    publisher = ZmqPublisher("zmq", ZmqOptions(bind=FREE, queue=2))
    with running(publisher) as view:
        publisher.handle([event()] * 500)
        assert publisher.details()["messages"] >= 500
        socket = subscriber(context, publisher)
        settle(publisher, socket, view)
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


@pytest.mark.parametrize(
    "options",
    [{"bind": "127.0.0.1:5"}, {"bind": "udp://x:1"}, {"queue": 0}, {"prefix": "a//b"}, {"hwm": 1}],
)
def test_wrong_options_are_refused(options):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(options, ZmqOptions)
