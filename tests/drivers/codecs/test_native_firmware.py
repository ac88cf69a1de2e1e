"""The C header for firmware, compiled, against the codecs of the native protocol."""

import dataclasses
import itertools
import random
import re
import shutil
import struct
import subprocess
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import CanFrame, Command, Samples
from tactile_rt.drivers.codecs.framing import crc16_xmodem
from tactile_rt.drivers.codecs.native import NativeOptions, NativeSerial, frame
from tactile_rt.drivers.codecs.native_can import NativeCan, NativeCanOptions
from tactile_rt.drivers.codecs.native_common import DeviceDescription, MessageType
from tactile_rt.testing import small_spec
from tests.helpers.codec_contract import T0, mutations

FIRMWARE = Path(__file__).parents[3] / "docs" / "firmware"
SPEC = small_spec(5)
BASE = 0x120
STRICT = "-std=c99 -Wall -Wextra -Werror -pedantic -Wconversion -Wshadow".split()

# Reads records from standard input, as `argv` says, and answers on standard output.
HARNESS = r"""
#include <stdio.h>
#include <stdlib.h>
#include "tactile_rt_native.h"

static void take(void *at, size_t n) { if (fread(at, 1, n, stdin) != n) exit(0); }
static void to_wire(void *to, const uint8_t *data, size_t n) {
    (void)to;
    fwrite(data, 1, n, stdout);
}
static void to_bus(void *to, uint32_t id, const uint8_t *data, uint8_t n) {
    uint8_t head[5];
    (void)to;
    trn_put32(head, id);
    head[4] = n;
    fwrite(head, 1, 5, stdout);
    fwrite(data, 1, n, stdout);
}

static void samples(trn_can *can, int serial, int wide) {
    static uint8_t head[13], valid[32], raw[4], out[TRN_SAMPLE_SIZE(255, 64, 4)];
    static float values[255 * 64];
    static int16_t counts[255 * 64];
    for (;;) {
        trn_sample s;
        size_t n, i, size;
        take(head, 13);
        s.elements = head[0]; s.channels = head[1]; s.status = trn_get16(head + 2);
        s.seq = trn_get32(head + 4); s.time_us = trn_get32(head + 8);
        s.valid = head[12] ? valid : NULL;
        if (head[12]) take(valid, TRN_MASK_SIZE(s.elements));
        n = (size_t)s.elements * s.channels;
        for (i = 0; i < n; i++) {
            take(raw, wide ? 4 : 2);
            if (wide) values[i] = trn_float_of(trn_get32(raw));
            else counts[i] = (int16_t)trn_get16(raw);
        }
        if (!serial) { if (wide) trn_can_f32(can, &s, values); else trn_can_i16(can, &s, counts); }
        else {
            size = TRN_SAMPLE_SIZE(s.elements, s.channels, wide ? 4 : 2);
            for (i = 0; i < size; i++)  /* never more than there is room for */
                if (i % 97 == 0 && (wide ? trn_sample_f32(out, i, &s, values)
                                         : trn_sample_i16(out, i, &s, counts))) exit(3);
            if ((wide ? trn_sample_f32(out, size, &s, values)
                      : trn_sample_i16(out, size, &s, counts)) != size) exit(4);
            fwrite(out, 1, size, stdout);
        }
    }
}

int main(int argc, char **argv) {
    static char json[65536];
    trn_device device = {json, 0, 1, 0, {0}};
    trn_can can = {0x120, 0, to_bus, NULL};
    char mode = argc > 1 ? argv[1][0] : 0;
    uint8_t two[2], *block;
    (void)argc;
    if (mode == 'c') { /* checksums and counts */
        uint8_t raw[8];
        block = (uint8_t *)"123456789";
        printf("%04x ", trn_crc16(trn_crc16(0, block, 4), block + 4, 5));
        printf("%08lx", (unsigned long)trn_crc32(0, block, 9));
        printf(" %08lx\n", (unsigned long)trn_crc32(trn_crc32(0, block, 4), block + 4, 5));
        for (;;) {
            take(raw, 8);
            printf("%d\n", trn_count(trn_float_of(trn_get32(raw)),
                                     trn_float_of(trn_get32(raw + 4))));
        }
    }
    can.fd = argv[1][1] == 'd';
    if (mode == 's') samples(&can, argv[1][1] == 's', argv[1][2] == 'f');
    take(two, 2);
    device.description_size = trn_get16(two);
    take(json, device.description_size);
    if (!device.description_size) device.description = NULL;
    if (mode == 'h') { /* host: blocks of bytes, each of exactly its size on the heap */
        trn_parser parser = {{0}, 0};
        while (fread(two, 1, 2, stdin) == 2) {
            size_t n = trn_get16(two);
            const uint8_t *data;
            trn_command command;
            block = malloc(n ? n : 1);
            take(block, n);
            data = block;
            while (trn_parse(&parser, &data, &n, &command))
                trn_answer(&device, &command, to_wire, NULL);
            free(block);
        }
    }
    if (mode == 'b') { /* bus: frames */
        uint8_t head[5];
        while (fread(head, 1, 5, stdin) == 5) {
            block = malloc(head[4] ? head[4] : 1);
            take(block, head[4]);
            trn_can_answer(&device, &can, trn_get32(head), block, head[4]);
            free(block);
        }
    }
    fprintf(stderr, "%d %.6f %.6f %.6f", device.streaming, (double)device.whisking[0],
            (double)device.whisking[1], (double)device.whisking[2]);
    return 0;
}
"""

# A board for example.c: commands from standard input, three milliseconds of samples for each read.
BOARD = r"""
#include <stdio.h>
#include <stdint.h>
const char board_description[] = DESCRIPTION;
const uint16_t board_description_size = sizeof board_description - 1;
const char board_serial[] = "A-17";
static uint32_t us;
uint32_t board_micros(void) { return us; }
int board_running(void) { return !feof(stdin); }
size_t board_read(uint8_t *data, size_t n) {
    us += 500;
    return fread(data, 1, n < 7 ? n : 7, stdin);
}
void board_write(void *to, const uint8_t *data, size_t n) { (void)to; fwrite(data, 1, n, stdout); }
int board_measure(float *values, uint8_t *valid) {
    int i;
    for (i = 0; i < 10; i++) values[i] = (float)us * 1e-6f + (float)i;
    valid[0] = 0x1F;
    return us % 1000 == 0;
}
"""


def build(folder: Path, source: str, *flags: str) -> Path:
    """Compile a program with the header; skip where there is no compiler."""
    if not shutil.which("gcc"):
        pytest.skip("no gcc here: the firmware header is not compiled")
    file = folder / "program.c"
    file.write_text(source)
    command = ["gcc", *STRICT, f"-I{FIRMWARE}", str(file), *flags, "-o", str(folder / "program")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and "cannot find" in done.stderr and any("sanitize" in f for f in flags):
        pytest.skip("gcc has no sanitizers here")
    assert done.returncode == 0, done.stderr
    return folder / "program"


def run(program: Path, mode: str, data: bytes) -> tuple[bytes, str]:
    done = subprocess.run([program, mode], input=data, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")[-2000:]
    return done.stdout, done.stderr.decode()


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("firmware"), HARNESS, "-O1")


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Path:
    flags = "-fsanitize=address,undefined -fno-sanitize-recover=all".split()
    return build(tmp_path_factory.mktemp("sanitized"), HARNESS, *flags)


def frames_of(data: bytes, fd: bool) -> list[CanFrame]:
    found, at = [], 0
    while at < len(data):
        identifier, n = struct.unpack_from("<IB", data, at)
        found.append(CanFrame(identifier, data[at + 5 : at + 5 + n], fd=fd))
        at += 5 + n
    return found


@dataclasses.dataclass(frozen=True)
class Case:
    """A sample of an array of some size."""

    spec: ArraySpec
    seq: int
    time_us: int
    valid: np.ndarray
    counts: np.ndarray  # (element, channel) int16

    @property
    def scale(self) -> np.ndarray:
        return np.asarray(DeviceDescription.of(self.spec).scale)

    @property
    def values(self) -> np.ndarray:
        return (self.counts * self.scale).astype(np.float32)

    def record(self, wide: bool, status: int = 0) -> bytes:
        """What the harness reads; the unused bits of the last byte of validity are set."""
        bits = bytearray(np.packbits(self.valid, bitorder="little").tobytes())
        bits[-1] |= 0xFF << (len(self.valid) - 8 * (len(bits) - 1)) & 0xFF
        some = not self.valid.all()  # else the device says so by giving none
        head = struct.pack("<BBHIIB", *self.spec.shape, status, self.seq, self.time_us, some)
        values = self.values.astype("<f4") if wide else self.counts.astype("<i2")
        return head + bytes(bits) * some + values.tobytes()

    def chunk(self) -> Chunk:
        t_ns = np.array([self.time_us * 1000], np.int64)
        return Chunk(np.array([self.seq], np.int64), t_ns, self.values[None], self.valid[None])


def array_of(elements: int, channels: int) -> ArraySpec:
    names = tuple(f"c{i}" for i in range(channels))
    return dataclasses.replace(small_spec(elements), channels=names, units=("N",) * channels)


def cases(n: int, most: tuple[int, int]) -> Iterator[Case]:
    draw = np.random.default_rng(5)
    sizes = [(1, 1), (8, 6), (9, 1), (35, 6), most]
    for k in range(n):
        elements, channels = sizes[k] if k < len(sizes) else draw.integers(1, 20, 2).tolist()
        counts = draw.integers(-32767, 32768, (elements, channels))
        seq, time_us = draw.integers(0, 2**32, 2).tolist()
        valid = draw.random(elements) < 0.8
        yield Case(array_of(elements, channels), seq, time_us, valid, counts)


def compare(samples: Samples | None, case: Case, wide: bool, status: int, bits: int) -> None:
    assert samples is not None and len(samples) == 1
    assert samples.count.tolist() == [case.seq % 2**bits]
    assert samples.ticks.tolist() == [case.time_us] and samples.status.tolist() == [status]
    assert np.array_equal(samples.valid[0], case.valid)
    assert np.array_equal(samples.values[0][case.valid], case.values[case.valid])


@pytest.mark.parametrize("form", ["float32", "int16"])
def test_serial_samples_are_those_of_the_codec(program: Path, form: str) -> None:
    wide, at = form == "float32", 0
    tried = list(cases(60, (255, 64)))
    wire, _ = run(program, f"ss{form[0]}", b"".join(c.record(wide) for c in tried))
    for case in tried:
        codec = NativeSerial(NativeOptions(format=form))
        codec.spec = case.spec
        (expected,) = codec.encode(case.chunk())
        assert wire[at : at + len(expected)] == expected
        compare(codec.feed(expected, T0), case, wide, 0, 32)
        at += len(expected)
    assert at == len(wire)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("form", ["float32", "int16"])
def test_can_samples_are_those_of_the_codec(program: Path, form: str, fd: bool) -> None:
    wide = form == "float32"
    tried = list(cases(40, (40, 9) if wide else (60, 12)))
    mode = f"s{'d' if fd else 'c'}{form[0]}"
    data, _ = run(program, mode, b"".join(c.record(wide) for c in tried))
    sent = frames_of(data, fd)
    for case in tried:
        codec = NativeCan(NativeCanOptions(base=BASE, fd=fd, format=form))
        codec.spec = case.spec
        (expected,) = codec.encode(case.chunk())
        assert sent[: len(expected)] == list(expected)
        compare(codec.feed(sent[: len(expected)], T0), case, wide, 0, 16)
        del sent[: len(expected)]
    assert not sent


def test_the_status_arrives(program: Path) -> None:
    (case,) = cases(1, (1, 1))
    codec = NativeSerial(NativeOptions())
    codec.spec = case.spec
    wire, _ = run(program, "ssf", case.record(True, status=0x8105))
    compare(codec.feed(wire, T0), case, True, 0x8105, 32)
    bus = NativeCan(NativeCanOptions(base=BASE))
    bus.spec = case.spec
    data, _ = run(program, "scf", case.record(True, status=0x8105))
    compare(bus.feed(frames_of(data, False), T0), case, True, 0x05, 16)


def test_a_sample_too_long_for_a_wire_is_not_sent(program: Path) -> None:
    case = Case(array_of(100, 8), 0, 0, np.ones(100, bool), np.zeros((100, 8), int))
    assert run(program, "sci", case.record(False))[0] == b""  # 269 classic frames
    assert run(program, "sdi", case.record(False))[0] != b""


def test_checksums_and_counts(program: Path) -> None:
    some, scale = np.random.default_rng(6).normal(0, 0.05, 2000), np.float32(0.1 / 32767)
    odd = [0, 0.1, -0.1, 1e30, -1e30, np.nan, np.inf, -np.inf]
    values = np.concatenate([some, odd]).astype(np.float32)
    pairs = np.stack([values, np.full_like(values, scale)], axis=1)
    lines = run(program, "c", pairs.astype("<f4").tobytes())[0].decode().split("\n")
    assert lines[0] == "31c3 cbf43926 cbf43926"  # the catalogue's
    assert crc16_xmodem(b"123456789") == 0x31C3 and zlib.crc32(b"123456789") == 0xCBF43926
    counts = np.array([int(x) for x in lines[1:-1]])
    assert counts[2000:].tolist() == [0, 32767, -32767, 32767, -32767, 0, 32767, -32767]
    exact = values[:2000].astype(np.float64) / np.float64(scale)
    # float32 division may fall on the other side of a half
    assert np.abs(counts[:2000] - np.clip(exact, -32767, 32767)).max() < 0.5 + 0.005


def device() -> NativeSerial:
    codec = NativeSerial(NativeOptions())
    codec.spec = SPEC
    return codec


def hosts(wire: bytes, cuts: list[int], json: bytes) -> bytes:
    """A description, then the wire in blocks, as the harness reads them."""
    edges = [0, *sorted(cuts), len(wire)]
    blocks = [wire[a:b] for a, b in itertools.pairwise(edges)]
    return b"".join(len(b).to_bytes(2, "little") + b for b in [json, *blocks])


def test_commands_are_obeyed_and_answered_as_by_the_codec(program: Path) -> None:
    host, emulated = NativeSerial(NativeOptions()), device()
    packets = [s.send for s in host.commands(Command.START)]
    packets += [host.whisk(8.0, 0.5, -0.25).send, host.whisk(float("nan"), 0, 0).send, frame(9)]
    packets += [frame(MessageType.WHISK, b"four"), frame(MessageType.ACK, b"\3\0"), frame(0)]
    wire = b"T noise TR" + b"R".join(packets)
    json = DeviceDescription.of(SPEC).to_json()
    draw = random.Random(1)
    for cuts in ([], range(1, len(wire)), draw.sample(range(1, len(wire)), 12)):
        answer, state = run(program, "h", hosts(wire, list(cuts), json))
        emulated = device()
        assert answer == emulated.respond(wire)
        assert state == "1 8.000000 0.500000 -0.250000"
        assert emulated.streaming and emulated.whisking == (8.0, 0.5, -0.25)
    found = NativeSerial(NativeOptions())
    found.feed(answer, T0)
    assert found.spec == SPEC
    both = frame(MessageType.START) + frame(MessageType.STOP)
    _, state = run(program, "h", hosts(both, [], json))
    assert state.startswith("0 ")
    # a device without a description says so
    answer, _ = run(program, "h", hosts(frame(MessageType.DESCRIBE), [], b""))
    assert answer == frame(MessageType.ACK, b"\1\2")


def test_messages_too_long_or_of_a_later_version_are_passed_over(sanitized: Path) -> None:
    later = bytearray(frame(MessageType.STOP))
    later[2] = 0x24
    later[18:20] = crc16_xmodem(bytes(later[2:18])).to_bytes(2, "little")
    later[-4:] = zlib.crc32(bytes(later[:-4])).to_bytes(4, "little")
    long = [frame(9, bytes(n)) for n in (33, 1000, 60_000)]
    start = frame(MessageType.START)
    for odd in (*long, bytes(later)):
        answer, state = run(sanitized, "h", hosts(odd + start, [], b""))
        assert answer == frame(MessageType.ACK, b"\3\0") and state[0] == "1"
    assert run(sanitized, "h", hosts(frame(9, bytes(32)), [], b""))[0] == frame(6, b"\x09\1")


@pytest.mark.parametrize("fd", [False, True])
def test_can_commands_are_obeyed_and_answered_as_by_the_codec(program: Path, fd: bool) -> None:
    options = NativeCanOptions(base=BASE, fd=fd)
    host, emulated = NativeCan(options), NativeCan(options)
    emulated.spec = SPEC
    sent = [f for s in host.commands(Command.START) for f in s.send]
    sent += [*host.whisk(8.0, 0.5, -0.25).send, CanFrame(BASE, b"\x09", fd=fd)]
    sent += [CanFrame(BASE, b"\5\1"), CanFrame(BASE, b"")]
    sent += [CanFrame(BASE + 1, b"\3"), CanFrame(BASE + 2, bytes(8))]
    json = DeviceDescription.of(SPEC).to_json()
    data = len(json).to_bytes(2, "little") + json + records(sent)
    answer, state = run(program, "bd" if fd else "bc", data)
    got = frames_of(answer, fd)
    assert got == list(emulated.respond(sent))
    assert emulated.whisking == pytest.approx((8.0, 0.5, -0.25))
    assert state == "1 8.000000 0.500000 -0.250000"
    found = NativeCan(options)
    found.feed(got, T0)
    assert found.spec == SPEC


def records(frames: list[CanFrame]) -> bytes:
    return b"".join(struct.pack("<IB", f.id, len(f.data)) + f.data for f in frames)


def test_no_input_leads_astray(sanitized: Path) -> None:
    """10^5 bytes of damaged commands: the sanitizers find nothing, the answers are the codec's."""
    host = NativeSerial(NativeOptions())
    commands = [s.send for s in (*host.commands(Command.START), *host.commands(Command.STOP))]
    commands += [host.whisk(8.0, 0.5, -0.25).send, frame(12, bytes(32)), frame(7, b"TR\x10")]
    wire, json = b"".join(commands * 3), DeviceDescription.of(SPEC).to_json()
    packets = mutations(wire, random.Random(3), 100_000)
    given = [json, *packets]
    data = b"".join(len(b).to_bytes(2, "little") + b for b in given)
    answer, _ = run(sanitized, "h", data)
    emulated = device()
    expected = b"".join(emulated.respond(p) for p in packets)
    assert answer == expected and emulated.stats.corrupt > 100 and emulated.stats.intact > 100


def test_no_frame_leads_astray(sanitized: Path) -> None:
    draw = random.Random(4)
    kinds = [bytes((k,)) + draw.randbytes(draw.randrange(8)) for k in (1, 2, 3, 4, 5, 5, 5, 6, 255)]
    frames = [
        CanFrame(draw.choice((BASE, BASE, BASE + 1, 0)), draw.choice(kinds)) for _ in range(3000)
    ]
    json = DeviceDescription.of(SPEC).to_json()[:100]
    data = len(json).to_bytes(2, "little") + json + records([*frames, CanFrame(BASE, b"")])
    answer, _ = run(sanitized, "bc", data)
    acks = [f for f in frames_of(answer, False) if f.id == BASE + 1]
    assert len(acks) == sum(f.id == BASE for f in frames)
    tried: list[Any] = list(cases(20, (60, 12)))
    for mode in ("ssi", "ssf", "sci", "scf", "sdi", "sdf"):
        run(sanitized, mode, b"".join(c.record(mode[2] == "f") for c in tried))


def fenced(language: str = "") -> list[str]:
    """The blocks of the protocol's document."""
    text = (FIRMWARE.parent / "reference" / "native-protocol.md").read_text()
    return [b.partition("\n")[2] for b in text.split("```")[1::2] if b.startswith(language + "\n")]


def test_the_documents_frames_and_description_are_the_codecs() -> None:
    (json,) = fenced("json")
    described = DeviceDescription.from_json(json.encode())
    assert described.scale == pytest.approx((0.1 / 32767, 1e-3 / 32767), 1e-4)
    codec = NativeSerial(NativeOptions())
    codec.spec = described.spec
    *serial, can = fenced()
    pairs = re.findall(r"(?<![-\w])[0-9A-F]{2}\b", " ".join(serial))
    samples = codec.feed(bytes.fromhex("".join(pairs)), T0)
    assert samples.values[:, 0].tolist() == [[1.5, -2.0], pytest.approx([0.1, -1e-3])]
    assert samples.count.tolist() == [7, 8] and samples.status.tolist() == [0, 1]
    assert (codec.serial_number, codec.spec) == ("A1", described.spec)
    assert codec.stats.intact == 8 and codec.stats.corrupt == codec.stats.skipped == 0
    bus = NativeCan(NativeCanOptions(base=0x100))
    bus.spec = described.spec
    lines = re.findall(r"^(10\d) ((?: [0-9A-F]{2})+)", can, re.M)
    samples = bus.feed([CanFrame(int(i, 16), bytes.fromhex(d)) for i, d in lines], T0)
    assert samples.values.tolist() == [[[1.5, -2.0]]] and samples.count.tolist() == [7]
    assert bus.stats.intact == 3 and bus.stats.corrupt == 0


def test_the_documents_rates_are_those_of_the_frames() -> None:
    text = (FIRMWARE.parent / "reference" / "native-protocol.md").read_text().replace(",", "")
    rows = re.findall(r"^\| (\d+) .*x (\d).*\n\| \| int16 .*", text, re.M)
    assert len(rows) == 4
    for match in re.finditer(r"^\| (\d+) .*x (\d).* \| float32 (.*)\n\| \| int16 (.*)", text, re.M):
        elements, channels = int(match[1]), int(match[2])
        for form, row in zip(("float32", "int16"), match.groups()[2:], strict=True):
            spec = array_of(elements, channels)
            case = Case(spec, 0, 0, np.ones(elements, bool), np.zeros(spec.shape, np.int16))
            line = NativeSerial(NativeOptions(format=form))
            buses = [NativeCan(NativeCanOptions(fd=fd, format=form)) for fd in (False, True)]
            for codec in (line, *buses):
                codec.spec = spec
            size = len(line.encode(case.chunk())[0])
            frames, long = (len(bus.encode(case.chunk())[0]) for bus in buses)
            told = re.findall(r"[\d.]+ (?:k?Hz|B|frames)", row)
            rates = [f"{baud / 10 / size:.0f} Hz" for baud in (460_800, 2e6, 3e6)]
            assert told[:4] == [f"{size} B", *rates]
            frame_hz = f"{9000 / frames:.0f} Hz"
            assert told[-3:] == [f"{frames} frames", frame_hz, f"{long} frames"]


def test_the_example_runs(tmp_path: Path) -> None:
    quoted = DeviceDescription.of(SPEC).to_json().decode().replace("\\", "\\\\").replace('"', '\\"')
    board = BOARD.replace("DESCRIPTION;", f'"{quoted}";')
    program = build(tmp_path, board, "-Wno-overlength-strings", str(FIRMWARE / "example.c"))
    host = NativeSerial(NativeOptions())
    steps = host.commands(Command.START)
    wire, _ = run(program, "", b"".join(s.send for s in steps) + bytes(140))
    for step in steps:
        assert step.expect is None or step.expect in wire
    samples = host.feed(wire, T0)
    assert host.spec == SPEC and samples is not None and samples.valid.all()
    numbered = NativeSerial(NativeOptions(serial_number="A-17"))
    numbered.spec = SPEC
    assert wire.startswith(numbered.respond(steps[0].send)) and host.serial_number == "A-17"
    assert (np.diff(samples.count) == 1).all() and (np.diff(samples.ticks) == 1000).all()
    assert samples.values[:, 0, 1] == pytest.approx(samples.ticks * 1e-6 + 1)
    assert host.stats.corrupt == host.stats.skipped == 0
