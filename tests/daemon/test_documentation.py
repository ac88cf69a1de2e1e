"""What docs/reference/messages.md and docs/reference/daemon.md show does what they say."""

import contextlib
import re
import select
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

from bench.daemon.process import free_port
from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.loading import load_config
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.metrics import exposition
from tactile_rt.daemon.process import ExitCode
from tactile_rt.daemon.publishers.foxglove import FoxgloveOptions, FoxglovePublisher
from tactile_rt.daemon.publishers.zenoh import ZenohOptions, ZenohPublisher
from tactile_rt.daemon.publishers.zmq import ZmqOptions, ZmqPublisher
from tests.helpers.published import FORCES, View, busy_snapshot, contact, decision, event, running

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text("utf-8"), re.S)


def example(kind):
    (text,) = [b for b in blocks("reference/messages.md", "python") if b.startswith(f"# {kind}: ")]
    return text


@contextlib.contextmanager
def consumer(kind, *arguments, **options):
    """The example as a process of its own."""
    with subprocess.Popen(
        [sys.executable, "-c", example(kind), *arguments],
        stdout=subprocess.PIPE, text=True, bufsize=1, **options,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def test_the_jsonl_example_reads_all_kinds():
    items = [contact(), decision(), event(level="error", reason="why"), event(), contact(False)]
    lines = "".join(f"{encode(message_of(i)).decode()}\n" for i in items)
    done = subprocess.run(
        [sys.executable, "-c", example("jsonl")],
        input=lines, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        "whiskers: touch", "whiskers: mug 75%", "daemon is running: why", "whiskers: let go",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["zmq", "zenoh", "foxglove"])
def test_the_example_of_each_publisher_reads_its_decisions(kind):
    at = f"tcp/127.0.0.1:{free_port()}"
    publisher = {
        "zmq": lambda: ZmqPublisher("x", ZmqOptions(bind="tcp://127.0.0.1:*")),
        "zenoh": lambda: ZenohPublisher("x", ZenohOptions(listen=(at,))),
        "foxglove": lambda: FoxglovePublisher("x", FoxgloveOptions(port=0)),
    }[kind]()
    with running(publisher, View(FORCES, busy_snapshot())):
        found = publisher.details()
        address = str(found.get("endpoint") or found.get("url") or found["listen"])
        with consumer(kind, address) as process:
            # What was said before it came is not for it: say it until it has heard.
            line = _heard(process, lambda: publisher.handle([decision(), event()]))
    assert line == "whiskers: mug 75%"


def _heard(process, say):
    for _ in range(600):
        say()
        ready, _, _ = select.select([process.stdout], [], [], 0.05)
        if ready:
            return process.stdout.readline().strip()
        assert process.poll() is None, "the example has ended"
    raise AssertionError("it heard nothing")


def test_the_example_configuration_is_right(tmp_path):
    (text,) = blocks("reference/daemon.md", "toml")
    (tmp_path / "robot.toml").write_text(text)
    check_config(load_config(tmp_path / "robot.toml"))


def test_every_metric_and_exit_code_is_in_the_table():
    guide = (DOCS / "reference" / "daemon.md").read_text("utf-8")
    names = re.findall(r"# TYPE tactile_(\S+) ", exposition(busy_snapshot()).decode())
    for name in names:
        shown = re.sub(r"^(model|consumer)_queue_.*", r"\1_queue_*", name)
        assert f"`{shown}`" in guide, name
    for code in ExitCode:
        assert f"\n| {code.value} | " in guide


@pytest.mark.usefixtures("still_clock")
def test_the_mqtt_example_does_as_it_says_to_a_stub(monkeypatch):
    client = mock.MagicMock()
    client.loop_start.return_value = 0
    client.publish.side_effect = [mock.Mock(rc=0), mock.Mock(rc=15)]
    stub = mock.MagicMock(Client=lambda *a, **k: client, MQTT_ERR_SUCCESS=0, MQTT_ERR_QUEUE_SIZE=15)
    paho = mock.Mock(**{"mqtt.client": stub})
    for name, module in (("", paho), (".mqtt", paho.mqtt), (".mqtt.client", stub)):
        monkeypatch.setitem(sys.modules, f"paho{name}", module)
    names: dict = {"__name__": "mqtt"}
    exec((DOCS / "publishers" / "mqtt.py").read_text("utf-8"), names)
    options = names["MqttOptions"](host="broker", state_s=0)
    publisher = names["MqttPublisher"]("m", options)
    with running(publisher):
        publisher.handle([decision(), event()])
    sent = [(c.args[0], c.args[1], c.kwargs["retain"]) for c in client.publish.call_args_list]
    assert sent == [
        ("tactile/whiskers/decision", encode(message_of(decision())), False),
        ("tactile/health", encode(message_of(event())), False),
    ]
    assert publisher.details()["dropped"] == 1
    client.loop_stop.assert_called_once_with()
