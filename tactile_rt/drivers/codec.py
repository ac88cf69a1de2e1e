"""Interface of the codecs, which convert bytes or CAN frames to samples, and back.

    wire --> Codec.feed --> Samples --> source (sequence, clock) --> Chunk
    Chunk --> Codec.encode --> wire          (an emulated device, answering by Codec.respond)

A codec is pure: no I/O, no clock, no thread. It trusts no input from the wire and never raises
because of it: input that fails a check is counted in `stats`.
"""

import abc
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import no_such
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.catalogue import CODECS

SIX_AXES = {**dict.fromkeys(("fx", "fy", "fz"), "N"), **dict.fromkeys(("mx", "my", "mz"), "N m")}


class Command(StrEnum):
    """A command from a host to a device; see `Codec.commands`."""

    START = "start"  # after connecting: configure it and let it stream
    STOP = "stop"  # before closing
    POLL = "poll"  # ask for one sample


class CanFrame(NamedTuple):
    """One CAN frame.

    Attributes:
        id: Arbitration identifier, of 11 bits, or of 29 if `extended`.
        data: Payload of the frame, 0 to 8 bytes, or up to 64 if `fd`.
        extended: Whether the identifier has 29 bits.
        remote: Whether the frame asks for data (RTR) and carries none.
    """

    id: int
    data: bytes = b""
    extended: bool = False
    fd: bool = False
    remote: bool = False


Packet = TypeVar("Packet", bytes, Sequence[CanFrame])


@dataclass(frozen=True)
class Step(Generic[Packet]):
    """A packet to send to a device, and the answer to wait for.

    Attributes:
        send: The packet to send; if empty, the host only waits.
        expect: Bytes in the answer, or the identifier of its CAN frame; None to wait for no
            answer.
        timeout_s: Longest time that the answer may take, s; a device that does not answer in time
            counts as absent.
        pause_s: Time to wait before the next step, answered or not, s.
    """

    send: Packet
    expect: bytes | int | None = None
    timeout_s: float = 1.0
    pause_s: float = 0.0
    what: str = ""


@dataclass(eq=False, slots=True)
class Samples:
    """Decoded samples, n >= 1, with the device's own counter and clock.

    Attributes:
        values: Measured values, (n, element, channel) float32, SI units.
        valid: Validity of each element, (n, element) bool; False where the device or the wire
            marks the values as missing.
        arrived_ns: Host time at which the last part of each sample arrived, (n,) int64, ns.
        damaged: Number of frames that failed a check since the previous sample, (n,) int64.
        count: The device's raw sample counter, (n,) int64, modulo 2^count_bits; None for a
            device without a counter.
        ticks: The device's raw clock, (n,) int64, modulo 2^tick_bits; None for a device
            without a clock.
        status: The device's status bits, (n,) int64; None for a device without them.
    """

    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    arrived_ns: NDArray[np.int64]
    damaged: NDArray[np.int64]
    count: NDArray[np.int64] | None = None
    ticks: NDArray[np.int64] | None = None
    status: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.arrived_ns)


@dataclass
class WireStats:
    """Counts of what a codec has received since it was made.

    Attributes:
        skipped: Bytes between frames; on CAN, frames with the identifiers of other devices.
        incomplete: Samples of which a part never came, from devices that send samples in parts.
    """

    intact: int = 0
    corrupt: int = 0
    skipped: int = 0
    incomplete: int = 0


class Codec(abc.ABC, Generic[Packet]):
    """Encoder and decoder of one device's protocol; base of `SerialCodec` and `CanCodec`.

    Args (of every implementation):
        options: The codec's options, an instance of its class `Options`.

    Attributes:
        Options: Frozen dataclass of what a URL may set; its docstring explains each field.
        count_bits: Width of the device's sample counter; None for a device without one.
        tick_ns: Length of a tick of the device's clock, ns; None for a device that sends no time.
        tick_bits: Width of the device's clock, which wraps at 2^tick_bits.
        status_bits: Meaning of each status bit when set, by the number of the bit.
        harmless_bits: Status bits that are no fault of the device: an overload, a state.
        cannot_detect: Losses and damage that this protocol cannot reveal, in a sentence.
        spec: The array that the samples are of; None until the device has described itself. If
            it is set beforehand, the device is not asked.
        measures: Emulation: whether the device measures before any host requests samples.
        describes: Whether the device describes itself when started; `spec` is then a new object.
        serial_number: Serial number that the device has reported; empty for none.
        newest: Emulation: newest sample of a device that measures and does not send, or None.
        commanded_hz: Emulation: sample rate that a host has commanded, Hz; None for none.
        complaint: Reason, for the user, why the last input is no sample; empty if unknown.
        full_scale: Largest load that a sample can hold, (channel,), SI; None if a frame itself
            proves which device it is from. `sniffing` attributes samples near it to another
            device.
    """

    wire: ClassVar[str]
    Options: ClassVar[type[Any]]
    count_bits: int | None = None
    tick_ns: float | None = None
    tick_bits: int = 32
    status_bits: ClassVar[dict[int, str]] = {}
    harmless_bits: ClassVar[frozenset[int]] = frozenset()
    cannot_detect: ClassVar[str] = ""
    complaint = ""
    describes = False
    serial_number = ""
    full_scale: ClassVar[tuple[float, ...] | None] = None
    greeting: ClassVar[Any] = None
    commanded_hz: float | None = None
    measures = False
    newest: Chunk | None = None

    def __init__(self, spec: ArraySpec | None) -> None:
        self.spec = spec
        self.stats = WireStats()

    @abc.abstractmethod
    def feed(self, packet: Packet, t_ns: int) -> Samples | None:
        """Decode received data, cut anywhere; return the samples that it completes, or None.

        Never raises on bad input. Except for arrival times, the result does not depend on how the
        input was cut.
        """

    @abc.abstractmethod
    def encode(self, chunk: Chunk) -> list[Packet]:
        """Encode samples as the device does; return one packet for each sample.

        Args:
            chunk: Samples of `spec`; `seq` is the device's counter and `t_ns` its clock, neither
                wrapped.
        """

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        """Return sets of options, other than the defaults, that change the device's frames.

        `sniffing` tries each of them to identify an unknown device.
        """
        return []

    def commands(self, command: Command) -> tuple[Step[Packet], ...]:
        """Return the packets, and the answers to await, by which a host sends a command."""
        return ()

    def respond(self, packet: Packet) -> Packet:
        """Return the device's answer to a packet from the host; used by an emulator.

        It also updates `streaming` and `polled`.
        """
        return packet[:0]

    streaming = True  # emulation: whether the device now sends without requests
    status = 0  # emulation: status bits to send, where the codec has them
    polled = 0  # emulation: number of samples requested and not yet sent
    polls = False  # whether the host must request each sample (`Command.POLL`)

    @abc.abstractmethod
    def forget(self) -> None:
        """Discard the beginning of an incomplete frame (after a reconnection)."""


class SerialCodec(Codec[bytes]):
    """Base of codecs for serial lines.

    Attributes:
        baud: Default speed of the device's line, bit/s.
        parity: Default parity of the device's line: ``N``, ``E`` or ``O``.
        usb: Whether the device itself is on USB, so that its baud rate has no effect.
    """

    wire = "serial"
    usb: ClassVar[bool] = False
    baud: ClassVar[int] = 115200
    parity: ClassVar[str] = "N"


class CanCodec(Codec[Sequence[CanFrame]]):
    """Base of codecs for CAN buses.

    Attributes:
        bitrate: Default speed of the device's bus, bit/s.
        data_bitrate: Default speed of the data phase, bit/s, of a CAN FD device; else None.
    """

    wire = "can"
    bitrate: ClassVar[int] = 1_000_000
    data_bitrate: ClassVar[int | None] = None


@dataclass
class SampleBatch:
    """Samples decoded from a packet; each list is empty or as long as `values`."""

    values: list[Any] = field(default_factory=list)  # each (element, channel), or flat
    valid: list[Any] = field(default_factory=list)
    damaged: list[int] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    status: list[int] = field(default_factory=list)

    def take(self, shape: tuple[int, int], t_ns: int) -> Samples | None:
        """Return the collected samples as one `Samples`; None if none were collected.

        Args:
            t_ns: Host time at which the samples arrived, ns.
        """
        n = len(self.values)
        if n == 0:
            return None
        values = np.asarray(self.values, dtype=np.float32).reshape(n, *shape)
        valid = np.asarray(self.valid, dtype=np.bool_) if self.valid else np.ones((n, 1), np.bool_)
        # a value that is not finite is no measurement, whatever the device's flags claim
        valid = valid & np.isfinite(values).all(axis=2)
        whole = [
            np.array(x, np.int64) if x else None for x in (self.count, self.ticks, self.status)
        ]
        damaged = np.array(self.damaged or [0] * n, np.int64)
        return Samples(values, valid, np.full(n, t_ns, np.int64), damaged, *whole)


def six_axis(name: str, rate_hz: float) -> ArraySpec:
    """Return the spec of a six-axis sensor: one element at the origin of ``sensor``.

    Its channels are fx, fy, fz in N and mx, my, mz in N m.
    """
    return ArraySpec.at_origin(name, rate_hz, SIX_AXES)


def codec_class(wire: str, name: str) -> type[Codec[Any]]:
    """Return the class of the codec with this name for ``serial`` or ``can``."""
    if (wire, name) in CODECS:
        module, attribute, _ = CODECS[wire, name]
        imported = import_module(module)
        if attribute.endswith(".toml"):
            described: type[Codec[Any]] = imported.frame_codec(name)
            return described
        found: type[Codec[Any]] = getattr(imported, attribute)
        return found
    theirs: type[Codec[Any]] | None = packages.import_addition(packages.CODECS, f"{wire}.{name}")
    if theirs is not None:
        return theirs
    known = {n for w, n in CODECS if w == wire}
    added = packages.added_names(packages.CODECS)
    known |= {n.partition(".")[2] for n in added if n.startswith(f"{wire}.")}
    other = {n for w, n in CODECS if w != wire} - known
    if name in other:
        elsewhere = "can" if wire == "serial" else "serial"
        raise ConfigError(f"codec {name} speaks over {elsewhere}:, not over {wire}:")
    raise ConfigError(no_such(f"{wire} codec", name, sorted(known)))
