"""The Zenoh publisher against a real session."""

import json
import time

import pytest
import zenoh

from bench.daemon.process import free_port
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.publishers.zenoh import ZenohOptions, ZenohPublisher
from tactile_rt.testing import small_spec
from tests.helpers.published import View, busy_snapshot, contact, decision, event, opened, running
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def peers():
    """Sessions of the test; `peers(listen=[...], connect=[...])`."""
    sessions = []

    def start(listen=(), connect=()):
        config = zenoh.Config()
        for key, value in (
            ("mode", "peer"), ("scouting/multicast/enabled", False),
            ("listen/endpoints", list(listen)), ("connect/endpoints", list(connect)),
        ):  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        sessions.append(zenoh.open(config))
        return sessions[-1]

    yield start
    for session in sessions:
        session.close()


def heard(session, key):
    """What a subscriber gets: (key, payload, encoding)."""
    got = []
    session.declare_subscriber(
        key, lambda s: got.append((str(s.key_expr), s.payload.to_bytes(), str(s.encoding)))
    )
    return got


@pytest.mark.usefixtures("still_clock")
def test_each_message_comes_under_its_key_expression(peers):
    at = f"tcp/127.0.0.1:{free_port()}"
    publisher = ZenohPublisher("z", ZenohOptions(listen=(at,), state_s=0))
    items = [opened(), decision(), contact(), event(), decision("b")]
    with running(publisher) as view:
        session = peers(connect=[at])
        got, chosen = heard(session, "tactile/**"), heard(session, "tactile/*/decision")
        until(lambda: publisher.handle([event(state="probe")]) or got)
        publisher.handle(items)
        until(lambda: got[-1][1] == encode(message_of(items[-1])))
        session.close()
        publisher.handle(items)  # nobody is there
        assert view.reports == []
    real = [g for g in got if b'"probe"' not in g[1]]
    assert [key for key, _, _ in real] == [
        "tactile/whiskers/array", "tactile/whiskers/decision", "tactile/whiskers/contact",
        "tactile/health", "tactile/whiskers/decision",
    ]  # fmt: skip
    assert [data for _, data, _ in real] == [encode(message_of(i)) for i in items]
    assert {kind for _, _, kind in real} == {"application/json"}
    assert len(chosen) == 2
    assert publisher.details()["messages"] >= 10


def test_it_goes_to_a_router_that_comes_later_and_tells_the_state_again_and_again(peers):
    at = f"tcp/127.0.0.1:{free_port()}"
    publisher = ZenohPublisher("z", ZenohOptions(listen=(), connect=(at,), state_s=0.01))
    with running(publisher, View(small_spec(), busy_snapshot())):
        publisher.handle([decision()])
        got = heard(peers(listen=[at]), "tactile/**")
        until(lambda: publisher.handle([]) or len(got) > 3)
    assert {"tactile/state", "tactile/whiskers/array"} <= {key for key, _, _ in got}


def test_a_peer_that_does_not_read_holds_nobody_up(peers):
    at = f"tcp/127.0.0.1:{free_port()}"
    publisher = ZenohPublisher("z", ZenohOptions(listen=(at,), state_s=0))
    with running(publisher):
        reader = peers(connect=[at]).declare_subscriber(
            "tactile/health", zenoh.handlers.FifoChannel(1)
        )
        until(lambda: publisher.handle([event()]) or reader.try_recv())
        fat = event(reason="x" * 200_000)
        for _ in range(200):  # 40 MB, more than all buffers on the way hold
            publisher.handle([fat])
        # It was all handed over, and what is read now is not all of it.
        found = 0
        until(lambda: reader.try_recv() is None)
        while reader.try_recv() is not None or (time.sleep(0.2) or reader.try_recv() is not None):
            found += 1
    assert found < 200


def test_an_address_that_is_taken_is_named_and_a_wrong_file_refused(peers, tmp_path):
    at = f"tcp/127.0.0.1:{free_port()}"
    peers(listen=[at])
    publisher = ZenohPublisher("z", ZenohOptions(listen=(at,)))
    with pytest.raises(SourceError, match="Address already in use"):
        publisher.open(View())
    publisher.close()
    with pytest.raises(ConfigError, match="No such file"):
        ZenohPublisher("z", ZenohOptions(config_file=str(tmp_path / "none.json5")))
    (tmp_path / "bad.json5").write_text("{ mode: 'nobody' }")
    with pytest.raises(ConfigError, match=r"^zenoh: "):
        ZenohPublisher("z", ZenohOptions(config_file=str(tmp_path / "bad.json5")))


def test_what_the_file_says_stays_and_what_is_said_beside_it_comes_on_top(tmp_path):
    at, other = "tcp/127.0.0.1:0", "tcp/127.0.0.1:7447"
    (tmp_path / "z.json5").write_text(
        f'{{ mode: "client", connect: {{ endpoints: ["{other}"] }} }}'
    )
    file = str(tmp_path / "z.json5")
    config = ZenohPublisher("z", ZenohOptions(config_file=file))._make_config()
    assert json.loads(config.get_json("connect/endpoints")) == [other]
    assert json.loads(config.get_json("mode")) == "client"
    config = ZenohPublisher("z", ZenohOptions(config_file=file, connect=(at,)))._make_config()
    assert json.loads(config.get_json("connect/endpoints")) == [at]
    plain = ZenohPublisher("z", ZenohOptions())._make_config()
    assert json.loads(plain.get_json("scouting/multicast/enabled")) is False
    assert all("127.0.0.1" in e for e in json.loads(plain.get_json("listen/endpoints")))
