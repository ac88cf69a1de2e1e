"""slcan against the examples of the LAWICEL CANUSB and CAN232 manuals."""

import random

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.slcan import SlcanAdapter, SlcanDecoder, closing, encode, opening

# CANUSB manual 1.0C, commands t, T, r, R and Z
MANUAL = [
    (b"t10021133\r", CanFrame(0x100, b"\x11\x33")),
    (b"t0200\r", CanFrame(0x20)),
    (b"T0000010021133\r", CanFrame(0x100, b"\x11\x33", extended=True)),
    (b"r1002\r", CanFrame(0x100, remote=True)),
    (b"R000001002\r", CanFrame(0x100, extended=True, remote=True)),
    (b"t100211334D67\r", CanFrame(0x100, b"\x11\x33")),  # with a time stamp
]
# CANable 2 firmware: the length is a DLC: 9 is 12 bytes, F is 64; b and B switch the bit rate
FD = [
    (b"d10021133\r", CanFrame(0x100, b"\x11\x33", fd=True)),
    (b"b1239" + b"0A" * 12 + b"\r", CanFrame(0x123, b"\n" * 12, fd=True)),
    (b"D1ABCDEF0F" + b"5A" * 64 + b"\r", CanFrame(0x1ABCDEF0, b"Z" * 64, True, True)),
    (b"B000001000\r", CanFrame(0x100, b"", True, True)),
]

frames_strategy = st.lists(
    st.builds(
        lambda extended, fd, ident, data: CanFrame(
            ident if extended else ident & 0x7FF, data if fd else data[:8], extended, fd
        ),
        st.booleans(),
        st.booleans(),
        st.integers(0, 0x1FFFFFFF),
        st.sampled_from([0, 1, 7, 8, 12, 64]).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
    ),
    max_size=20,
)


@pytest.mark.parametrize(("line", "frame"), MANUAL + FD)
def test_the_manual_s_lines(line: bytes, frame: CanFrame) -> None:
    decoder = SlcanDecoder()
    assert decoder.feed(line) == [frame]
    assert decoder.feed(line[:3]) == []
    assert decoder.feed(line[3:]) == [frame]
    assert decoder.feed(line.lower().replace(line[:1].lower(), line[:1], 1)) == [frame]


def test_frames_are_written_as_the_manual_does() -> None:
    assert encode([CanFrame(0x100, b"\x11\x33"), CanFrame(0x20)]) == b"t10021133\rt0200\r"
    assert encode([CanFrame(0x100, b"\x11\x33")], 0x4D67) == b"t100211334D67\r"
    assert encode([CanFrame(0x100, b"\x11\x33")], 60_000 + 0x4D67) == b"t100211334D67\r"
    assert encode([CanFrame(0x100, b"\x11\x33", True)]) == b"T0000010021133\r"
    assert encode([CanFrame(0x100, remote=True)]) == b"r1000\r"
    assert encode([CanFrame(0x100, b"x" * 9, fd=True)]) == b"b1009" + b"78" * 9 + b"000000\r"
    assert encode([]) == b""


@given(frames_strategy, st.booleans(), st.lists(st.integers(0, 2000), max_size=5))
def test_what_is_encoded_is_decoded_however_it_is_cut(frames, stamped, cuts):
    wire = encode(frames, 12_345 if stamped else None)
    decoder = SlcanDecoder()
    found = []
    edges = [0, *sorted(min(c, len(wire)) for c in cuts), len(wire)]
    for a, b in zip(edges, edges[1:], strict=False):  # noqa: RUF007
        found += decoder.feed(wire[a:b])
    assert found == frames


def test_answers_are_told_from_frames() -> None:
    frame = CanFrame(0x100, b"\x11\x33")
    wire = b"\r\r\aV1013\r" + encode([frame]) + b"NA123\rz\rZ\r\aF08\r" + encode([frame])
    assert SlcanDecoder().feed(wire) == [frame, frame]
    assert SlcanDecoder().feed(b"t10021133\r\nt0200\r\n") == [frame, CanFrame(0x20)]


@pytest.mark.parametrize(
    "line",
    [
        b"t1002113", b"t100211333", b"t10091122334455667788", b"t8000", b"T200000000", b"t10g0",
        b"t1002 133", b"t1002+133", b"t10_0", b"t", b"r100", b"q", b"t10021133\a", b"x" * 4000,
        b"d100G", b"\xff\xfe", b"t10021133XYZW", b"V" * 60,
    ],
)  # fmt: skip
def test_a_line_that_is_no_frame_is_passed_over(line: bytes) -> None:
    good = encode([CanFrame(0x20)] * 2)
    assert SlcanDecoder().feed(good + line + b"\r" + good) == [CanFrame(0x20)] * 4


def test_a_shorter_length_is_not_taken_for_a_time_stamp() -> None:
    """Bit 1 of the length: 6 becomes 4, and the last two bytes look like a time stamp."""
    line = encode([CanFrame(0x100, bytes(6))])
    decoder = SlcanDecoder()
    assert len(decoder.feed(line + line.replace(b"t1006", b"t1004") + line)) == 2
    # time stamps switched on meanwhile: believed from the second line on
    assert len(decoder.feed(encode([CanFrame(0x100)] * 3, 7))) == 2


def test_no_input_raises_or_piles_up() -> None:
    draw = random.Random(3)
    decoder = SlcanDecoder()
    wire = encode([CanFrame(draw.randrange(2048), draw.randbytes(8)) for _ in range(300)])
    whole, pieces = SlcanDecoder(), SlcanDecoder()
    for _ in range(300):
        at = draw.randrange(len(wire))
        hurt = bytearray(wire[at : at + draw.randrange(400)])
        for _ in range(draw.choice((0, 1, 40))):
            if hurt:
                hurt[draw.randrange(len(hurt))] = draw.randrange(256)
        decoder.feed(bytes(hurt))
        a = whole.feed(bytes(hurt))
        b = [f for i in range(0, len(hurt), 7) for f in pieces.feed(bytes(hurt[i : i + 7]))]
        assert a == b
    for _ in range(100):
        decoder.feed(b"t" * 10_000)  # no end of line
    assert len(decoder._rest) < 200
    assert decoder.feed(b"\rt0200\r") == [CanFrame(0x20)]


def test_a_host_opens_and_closes_an_adapter() -> None:
    adapter = SlcanAdapter()
    frame = CanFrame(0x100, b"\x11\x33")
    assert adapter.encode([frame]) == b""
    assert adapter.respond(b"t0200\r") == (b"\a", [])
    answers = [adapter.respond(command)[0] for command in opening(1_000_000)]
    assert answers == [b"\r\r\r", b"\a", b"\r", b"\r"]
    assert adapter.encode([frame]) == b"t10021133\r"
    assert adapter.respond(b"t100211") == (b"", [])
    assert adapter.respond(b"33\rT0000010021133\rr1002\r") == (
        b"z\rZ\rz\r",
        [frame, frame._replace(extended=True), CanFrame(0x100, remote=True)],
    )
    assert adapter.respond(b"V\rN\rF\r")[0] == b"V1013\rNA123\rF00\r"
    assert adapter.respond(b"O\rS6\rK\rt10g0\r") == (b"\a\a\a\a", [])  # open already, and no such
    assert adapter.respond(closing())[0] == b"\r"
    assert adapter.respond(b"Z1\rO\r")[0] == b"\r\r"
    assert adapter.encode([frame], 0x4D67 * 1_000_000) == b"t100211334D67\r"


def test_the_commands_are_the_manual_s() -> None:
    assert opening(500_000) == (b"\r\r\r", b"C\r", b"S6\r", b"O\r")
    with pytest.raises(ConfigError, match=r"bitrate 333000: there are 10000, .*1000000"):
        opening(333_000)


def test_another_bit_rate_than_the_bus_s_hears_nothing() -> None:
    adapter = SlcanAdapter(bitrate=500_000)
    for command in opening(1_000_000):
        adapter.respond(command)
    assert adapter.open and not adapter.hears
    assert adapter.encode([CanFrame(1)]) == b"" and adapter.respond(b"t0200\r") == (b"z\r", [])
    assert adapter.respond(b"F\r")[0] == b"F80\r"
    for command in opening(500_000):
        adapter.respond(command)
    assert adapter.encode([CanFrame(0x20)]) == b"t0200\r"


def test_python_can_writes_what_we_read() -> None:
    """Its slcan interface as an independent writer of lines, on pyserial's loopback port."""
    bus = can.Bus("loop://", "slcan", bitrate=500_000, sleep_after_open=0)
    port = bus.serialPortOrig
    assert port.read(port.in_waiting) == b"C\rS6\r\rO\rO\r"
    sent = [
        can.Message(arbitration_id=0x123, data=bytes(range(8)), is_extended_id=False),
        can.Message(arbitration_id=0x1ABCDEF0, data=b"\xff", is_extended_id=True),
        can.Message(arbitration_id=5, is_remote_frame=True, is_extended_id=False),
        can.Message(arbitration_id=5, data=bytes(12), is_fd=True, is_extended_id=False),
    ]
    for message in sent:
        bus.send(message)
    assert SlcanDecoder().feed(port.read(port.in_waiting)) == [
        CanFrame(0x123, bytes(range(8))),
        CanFrame(0x1ABCDEF0, b"\xff", extended=True),
        CanFrame(5, remote=True),
        CanFrame(5, bytes(12), fd=True),
    ]
    port.write(encode([CanFrame(0x123, b"\x01\xab"), CanFrame(0x10, bytes(20), fd=True)]))
    one, two = bus.recv(1), bus.recv(1)
    assert (one.arbitration_id, bytes(one.data)) == (0x123, b"\x01\xab")
    assert two.is_fd and two.bitrate_switch and bytes(two.data) == bytes(20)
    bus.shutdown()
