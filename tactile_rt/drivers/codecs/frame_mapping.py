"""Description of a binary frame of a serial sensor, as in docs/codecs/binary_frame.toml.

Offsets count from the frame's first byte, 0. Bytes are written in hexadecimal, ``AA 07``.
"""

from typing import Annotated, Final, Literal, TypeAlias

import msgspec

from tactile_rt.drivers.codecs.ascii_mapping import ArrayTable

LONGEST: Final = 65_536  # bytes of a frame
UNHEARD: Final = "-"  # channel of numbers that are not delivered

Order: TypeAlias = Literal["little", "big"]
Kind: TypeAlias = Literal[
    "int8", "uint8", "int16", "uint16", "int24", "uint24", "int32", "uint32", "int64", "float32",
    "float64",
]  # fmt: skip
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=10_000)]
Range: TypeAlias = tuple[float, float]
At: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=LONGEST)]
Whole: TypeAlias = Literal["uint8", "uint16", "uint24", "uint32"]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Checksum(_Table, frozen=True, kw_only=True):
    """Table ``[checksum]``: the checksum of a frame.

    Attributes:
        at: Offset of the checksum; -1: directly before `ends`, or else at the end of the frame.
        first: Offset of the first byte that it covers.
        order: Byte order of the checksum; empty for that of the file.
    """

    name: str
    at: Annotated[int, msgspec.Meta(ge=-1, lt=LONGEST)] = -1
    first: At = 0
    order: Order | Literal[""] = ""


class Values(_Table, frozen=True, kw_only=True):
    """Table ``[[values]]``: adjacent numbers of one type, element by element.

    Attributes:
        channels: Names of the channels; ``-`` for numbers that are not delivered, but checked
            against `possible` and `valid`.
        elements: Names of the elements; an integer n for ``T0`` to ``Tn-1``, two for the rows
            (``A``, ``B``, ...) and columns (``A0``, ``A1``, ...) of a matrix.
        unit: Unit of `scale`; empty for the SI unit of channels with usual names.
        scale: Value of a raw 1 in `unit`, for all channels or for each in turn.
        stride: Bytes from one element to the next, if other numbers lie between; 0 for none. (By
            channel: from one channel to the next.)
        possible: Least and largest raw number that the device can send; any other number is no
            measurement, and without a `sync` its bytes are no frame.
        smallest: Smallest magnitude other than 0 of a raw number that the device can send.
        valid: Least and largest raw number for which the element is valid.
        by: Whether all channels of an ``element`` come together, or all elements of a ``channel``.
        order: Byte order of the numbers; empty for that of the file.
    """

    at: At
    type: Kind
    channels: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    elements: Count | tuple[str | Count, ...] = ("sensor",)
    unit: str = ""
    scale: float | tuple[float, ...] = 1.0
    offset: float = 0.0
    stride: At = 0
    possible: Range | None = None
    smallest: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    valid: Range | None = None
    by: Literal["element", "channel"] = "element"
    order: Order | Literal[""] = ""


class FrameCounter(_Table, frozen=True, kw_only=True):
    """Table ``[count]``: the sample counter, which wraps at its width.

    Attributes:
        order: Byte order of the number; empty for that of the file.
    """

    at: At
    type: Whole
    order: Order | Literal[""] = ""


class FrameClock(FrameCounter, frozen=True, kw_only=True):
    """Table ``[time]``: the time of a sample by the device's clock.

    Attributes:
        tick_us: Length of a tick, us.
    """

    tick_us: Annotated[float, msgspec.Meta(gt=0)]


class FrameStatus(FrameCounter, frozen=True, kw_only=True):
    """Table ``[status]``: the status bits of the device.

    Attributes:
        bits: Meaning of each bit when set, by its number.
        invalid: Numbers of the bits that mark values as invalid; an emulated device sets the first.
        harmless: Numbers of the bits that are no fault of the device.
    """

    bits: dict[str, str] = {}
    harmless: tuple[Annotated[int, msgspec.Meta(ge=0, lt=32)], ...] = ()
    invalid: tuple[Annotated[int, msgspec.Meta(ge=0, lt=32)], ...] = ()


class Message(_Table, frozen=True, kw_only=True):
    """Table ``[[start]]`` or ``[[stop]]``: a message that the host sends, in order.

    Attributes:
        send: Bytes to send, or ``text:...`` for characters; empty to wait only.
        expect: Bytes in the answer; empty to wait for no answer.
        wait_s: Longest time that the answer may take, s.
        pause_s: Time to wait before the next message, s.
    """

    send: str
    expect: str = ""
    wait_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 1.0
    pause_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.0


class FrameMapping(ArrayTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Contents of a mapping file, which describes a frame.

    Attributes:
        length: Length of a frame, bytes.
        sync: The bytes with which each frame begins; empty for frames with a fixed ending only.
        usually: Bytes with which most frames begin, if a sync of one or two bytes is no evidence
            that damaged bytes were a frame.
        baud: Speed of the line, bit/s.
        usb: Whether the device itself is on USB, so that its baud rate has no effect.
        parity: Parity of the line: ``N``, ``E`` or ``O``.
        order: Byte order of all numbers without an order of their own.
        ends: The bytes with which each frame ends; empty if they vary.
        between: Other messages that the device sends between frames, such as answers, in
            hexadecimal where ``..`` stands for any byte, or ``text:...``.
        poll: Message that the host sends for each sample; empty if the device sends by itself.
    """

    length: Annotated[int, msgspec.Meta(ge=2, le=LONGEST)]
    values: Annotated[tuple[Values, ...], msgspec.Meta(min_length=1)]
    baud: Annotated[int, msgspec.Meta(ge=1)] = 115200
    usb: bool = False
    parity: Literal["N", "E", "O"] = "N"
    order: Order = "little"
    sync: str = ""
    usually: str = ""
    ends: str = ""
    between: tuple[str, ...] = ()
    checksum: Checksum | None = None
    count: FrameCounter | None = None
    time: FrameClock | None = None
    status: FrameStatus | None = None
    start: tuple[Message, ...] = ()
    stop: tuple[Message, ...] = ()
    poll: str = ""
