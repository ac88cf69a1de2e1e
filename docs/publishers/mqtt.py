"""Messages over MQTT 5 (paho-mqtt 2). UNTESTED: it has not been run against a broker.

[project.entry-points."tactile_rt.publishers"]
mqtt = "tactile_mqtt:MqttPublisher"

[[publisher]]
kind = "mqtt"
options = { host = "broker.lan" }
"""

from typing import Annotated

import msgspec
import paho.mqtt.client as mqtt

from tactile_rt.core.errors import SourceError
from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.messages import Message, encode, topic_of
from tactile_rt.daemon.publishers.sending import Sender, SenderOptions

RETAINED = ("array", "state")  # whoever subscribes later gets the newest of these at once
QUEUE = 1000  # messages that wait for a broker that is away


class MqttOptions(SenderOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "mqtt"``; the daemon never shows what is called password."""

    host: str
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 1883
    username: str = ""
    password: str = ""
    tls: bool = False


class MqttPublisher(Sender):
    Options = MqttOptions

    def __init__(self, name: str, options: MqttOptions) -> None:
        super().__init__(name, options)
        self._options = options
        self._client: mqtt.Client | None = None
        self._dropped = 0

    def _connect(self, view: View) -> None:
        options = self._options
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        client.max_queued_messages_set(QUEUE)
        if options.username:
            client.username_pw_set(options.username, options.password)
        if options.tls:
            client.tls_set()
        client.connect_async(options.host, options.port)
        if client.loop_start() != mqtt.MQTT_ERR_SUCCESS:
            raise SourceError(f"mqtt: no connection to {options.host}:{options.port}")
        self._client = client

    def _send(self, message: Message) -> int:
        assert self._client is not None
        data = encode(message)
        sent = self._client.publish(
            topic_of(message, self._options.prefix), data, retain=type(message).topic in RETAINED
        )
        if sent.rc == mqtt.MQTT_ERR_QUEUE_SIZE:
            self._dropped += 1
        return len(data)

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            client.loop_stop()

    def details(self) -> dict[str, str | int | float]:
        return {**super().details(), "messages": self._messages, "dropped": self._dropped}
