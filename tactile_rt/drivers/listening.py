"""What comes over a line that nobody knows anything about, at one speed after the other."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame, Codec, Command, codec_class
from tactile_rt.drivers.device_source import DeviceOptions, DeviceSource
from tactile_rt.drivers.links import Link, SerialLink
from tactile_rt.drivers.opening import make_codec, open_line
from tactile_rt.drivers.sniffing import NEEDS_A_FILE
from tactile_rt.errors import ConfigError, SourceError
from tactile_rt.stream import EndOfStream

__all__ = ["SPEEDS", "ask_devices", "hear_bus", "hear_port", "line_speeds"]

# Of boards that print, besides those that codecs name.
SPEEDS: Final = (9600, 57600, 230_400, 38_400, 250_000, 500_000)
FIRST_S: Final = 2.5  # for a board that begins anew when its port is opened
START_S: Final = 0.6  # for a device that was asked
MOST_BYTES: Final = 262_144

Heard = tuple[int, str, bytes]  # baud, parity, what came


def line_speeds() -> list[tuple[int, str]]:
    """(baud, parity) of every serial codec, the most usual first, then of other boards."""
    found: list[tuple[int, str]] = []
    for wire, name in CODECS:
        if wire != "serial":
            continue
        try:
            kind = codec_class(wire, name)
            codec: Any = kind if set(NEEDS_A_FILE) & set(
                kind.Options.__dataclass_fields__
            ) else make_codec(wire, name, {})  # fmt: skip
        except ConfigError:
            continue  # what it needs is not installed
        found.append((codec.baud, codec.parity))
    usual = sorted(set(found), key=lambda speed: (-found.count(speed), speed))
    return usual + [(s, "N") for s in SPEEDS if (s, "N") not in usual]


def hear_port(
    port: str, seconds: float, speeds: list[tuple[int, str]], dtr: bool = True
) -> Iterator[Heard]:
    """What comes over a serial port at each of these speeds; it is opened once.

    Args:
        port: the port.
        seconds: how long to listen at each, s.
        speeds: (baud, parity) of each.
        dtr: whether to assert DTR, at which many boards begin anew.

    Raises:
        SourceError: it cannot be opened, or is gone.
    """
    link = SerialLink(port, *speeds[0], dtr)
    try:
        wait = FIRST_S
        for k, (baud, parity) in enumerate(speeds):
            if k:
                link.retune(baud, parity)
            found = link.receive(wait)
            wait = seconds
            data = bytearray(found[0] if found else b"")
            end = time.monotonic() + seconds
            while found and (left := end - time.monotonic()) > 0 and len(data) < MOST_BYTES:
                more = link.receive(left)
                data += more[0] if more else b""
            yield baud, parity, bytes(data)
    finally:
        link.close()


def hear_bus(url: str, seconds: float) -> list[CanFrame]:
    """The frames that come over a CAN bus.

    Args:
        url: ``can:INTERFACE:CHANNEL``, with the bus's options.
        seconds: how long to listen, s.
    """
    link: Link[Any] = open_line(url)
    frames: list[CanFrame] = []
    try:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            found = link.receive(left)
            frames += found[0] if found else ()
    finally:
        link.close()
    return frames


def ask_devices(
    wire: str, connect: Callable[[Codec[Any]], Link[Any]], seconds: float
) -> Iterator[tuple[Codec[Any], Any]]:
    """Each codec whose device must be asked to send, and what then comes: bytes, or frames.

    Args:
        seconds: how long to listen after the first sample, s.
    """
    connect(_plain(wire)).close()  # told once, not for every codec
    for of, name in CODECS:
        if of != wire:
            continue
        try:
            kind = codec_class(wire, name)
            if set(NEEDS_A_FILE) & set(kind.Options.__dataclass_fields__):
                continue
            codec = make_codec(wire, name, {})
        except ConfigError:
            continue
        if not codec.polls and not codec.commands(Command.START):
            continue
        heard: list[Any] = []
        try:
            with DeviceSource(
                lambda codec=codec: connect(codec), codec,  # type: ignore[misc]
                DeviceOptions(name, start_s=START_S, reconnect=False), name,
            ) as source:  # fmt: skip
                source.tap(partial(_keep, heard))
                end = time.monotonic() + seconds
                while (left := end - time.monotonic()) > 0:
                    source.read(left)
        except (SourceError, EndOfStream):
            continue
        packets = [p for p in heard if p is not None]
        whole: Any = b"".join(packets) if wire == "serial" else [f for p in packets for f in p]
        yield codec, whole


def _keep(heard: list[Any], packet: Any, t_ns: int) -> None:
    heard.append(packet)


def _plain(wire: str) -> Codec[Any]:
    return make_codec(wire, "native", {})
