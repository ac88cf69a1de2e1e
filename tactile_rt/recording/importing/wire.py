"""Import of a log of a serial line or CAN bus: a codec decodes it; the packets are stored, too.

Packets with a time of arrival are decoded as in live use. If the log has no times, the device's own
clock dates the samples. A device without a clock is assumed to have sent at its nominal rate,
including the samples that were lost according to its counter or damaged frames.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

from tactile_rt.classifier.array_file import read_array
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import NS_PER_S, Chunk, SourceStats
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.clocks import DeviceTime, Stamper
from tactile_rt.drivers.codec import Codec, Command, Samples, codec_class
from tactile_rt.drivers.logs import CAN_FORMS, LineLog, Occurrences
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording.description import SUMMARY, Description
from tactile_rt.recording.importing.report import Import, clock_of, measure_samples
from tactile_rt.recording.layout import SAMPLES, WIRE, encode_packet, encode_samples
from tactile_rt.recording.writer import McapFile

PROBED, SHORTEST = 16_384, 8  # bytes: of a log to probe; of a piece, at least
FEW, UNUSUAL = 10, 1.2  # samples for a rate; factor by which it may be off the codec's rate
LAST = 4  # last packets, which are fed byte by byte
AHEAD = 4096  # packets in which a device may describe itself


def import_wire(
    log: LineLog, output: Path, fields: Mapping[str, str], rate_hz: float = 0.0
) -> Import:
    """Decode a log, and write samples and packets as a recording.

    Args:
        output: the recording to write, whole or not at all.
        fields: ``codec`` and its options, as in a URL, also ``array``.
        rate_hz: rate of the samples, Hz; 0 for the codec's rate.

    Raises:
        ConfigError: no such codec or option, or the log lacks the device's description of itself.
    """
    codec, about = _prepare(log, fields, rate_hz)
    log.names = getattr(codec, "names", {})
    if log.form == "raw":
        log.piece = _measure_sample(log, make_codec(log.wire, about.codec, _select_options(fields)))
    account, stats = Import(), SourceStats()

    def fill(file: BinaryIO) -> None:
        decoded = _DecodedLog(log, codec, about, stats)
        made = McapFile(file, decoded.about)
        made.add(WIRE, encode_packet(None, about.wire), 0)
        packets = 0
        for packet, t_ns, chunk in decoded:
            made.add(WIRE, encode_packet(packet, about.wire), t_ns)
            packets += 1
            if chunk is None:
                continue
            own = decoded.about.clock == "device"
            made.add(SAMPLES, encode_samples(chunk), t_ns if own else int(chunk.t_ns[-1]))
            account.samples += len(chunk)
        if not account.samples:
            raise RecordingError(f"{log.path}: {_explain_empty(log, codec, str(fields['codec']))}")
        if log.wire == "serial" and decoded.unfinished:
            account.notes.append(f"it ends with {decoded.unfinished} bytes of no whole sample")
        if passed := getattr(codec, "passed", 0):
            account.notes.append(
                f"lines skipped, of text or of a sample whose beginning is not there: {passed}"
            )
        made.note(SUMMARY, {"samples": str(account.samples), "packets": str(packets)})
        made.finish()
        _fill_account(log, decoded, account)

    write_whole(output, fill)
    measure_samples(account, output)
    account.intact, account.corrupt = codec.stats.intact, codec.stats.corrupt
    account.missing, account.notes = stats.missing, [*log.notes, *account.notes]
    if codec.stats.incomplete:
        account.notes.append(f"{codec.stats.incomplete} samples lack a part")
    if stats.duplicates:
        account.notes.append(f"{stats.duplicates} samples came twice")
    came_hz = (account.samples + account.missing - 1) / (account.seconds or 1.0)
    claimed = getattr(codec, "claims_rate", True)
    if account.found_hz is not None:
        account.found_hz = came_hz
        other = f"{came_hz:.4g}" != f"{account.rate_hz:.4g}"
        if account.samples >= FEW and not claimed and other:
            made = import_wire(log, output, fields, float(f"{came_hz:.6g}"))
            made.said_hz = None
            return made
    elif not claimed:
        account.notes.append(
            f"the rate is not known: {account.rate_hz:g} Hz is assumed; --rate sets it"
        )
    account.said_hz = account.rate_hz if claimed else None
    if account.samples >= FEW and not UNUSUAL > came_hz / account.rate_hz > 1 / UNUSUAL:
        account.notes.append(
            f"they came at {came_hz:.4g} Hz, not at {account.rate_hz:g} Hz as is claimed: --rate "
            "says what the device was set to"
        )
        account.rate_hz = came_hz
    return account


def _fill_account(log: LineLog, decoded: "_DecodedLog", account: Import) -> None:
    account.unit = {"raw": "bytes", "blf": "objects", "db": "frames"}.get(log.form, "lines")
    account.total, account.read = log.total, log.frames
    if log.form == "raw":
        account.read = log.total - decoded.skipped - decoded.unfinished
    account.passed_over = account.total - account.read
    account.out_of_order = log.back.n
    account.found_hz = 1.0 if decoded.timed else None
    if decoded.clock_steps:
        account.notes.append(f"the device's clock goes back {decoded.clock_steps} times")
    if decoded.corrupt.n:
        account.notes.append(f"corrupt frames: {decoded.corrupt}")


def _prepare(
    log: LineLog, fields: Mapping[str, str], rate_hz: float
) -> tuple[Codec[Any], Description]:
    """Return the codec, and the recording's description before any packet is decoded."""
    own, name, array = _select_options(fields), fields.get("codec", ""), fields.get("array", "")
    if not name:
        raise ConfigError("--as needs codec=NAME, see `tactile-rt codecs`")
    if log.form == "raw" and ("can", name) in CODECS and ("serial", name) not in CODECS:
        raise ConfigError(
            f"{log.path} is no CAN log of {', '.join(CAN_FORMS)}, and codec {name} speaks over "
            "can:; --form says which it is"
        )
    if rate_hz and "rate_hz" in codec_class(log.wire, name).Options.__dataclass_fields__:
        own.setdefault("rate_hz", f"{rate_hz:g}")
    codec = make_codec(log.wire, name, own)
    written = {k: str(Path(v).resolve()) if k == "mapping" else v for k, v in own.items()}
    if array and codec.spec is None:
        codec.spec = read_array(Path(array))
        written["array"] = codec.spec.to_json()
    elif array:
        raise ConfigError(f"array= is not for codec {name}, which has its own array")
    if rate_hz and codec.spec is not None and codec.spec.rate_hz != rate_hz:
        codec.spec = replace(codec.spec, rate_hz=rate_hz)
    about = Description(
        codec.spec,  # type: ignore[arg-type]  # None until the packets describe the array
        0, f"{log.path.name}", log.wire, name, written,
        session={"imported": log.path.name, "form": log.form},
    )  # fmt: skip
    return codec, about


def _select_options(fields: Mapping[str, str]) -> dict[str, str]:
    """Return the fields that are options of the codec."""
    return {k: v for k, v in fields.items() if k not in ("codec", "array")}


def _measure_sample(log: LineLog, codec: Codec[Any]) -> int:
    """Measure the mean bytes per sample, so that packets of that size hold one sample."""
    size = frames = 0
    for packet, _ in log.packets():
        codec.feed(packet, 0)
        size, frames = size + len(packet), codec.stats.intact
        if size >= PROBED:
            break
    return max(SHORTEST, size // max(1, frames))


class _DecodedLog:
    """Iterable of (packet, time of arrival in ns, samples that it completes) of a log."""

    def __init__(
        self, log: LineLog, codec: Codec[Any], about: Description, stats: SourceStats
    ) -> None:
        self._codec, self._now, self._rest = codec, 0, 0
        self.skipped = self._at = 0  # bytes outside frames up to the newest sample; of packets
        self.corrupt = Occurrences(
            "frame" if log.wire == "can" else "byte" if log.form == "raw" else "packet"
        )
        self._count: int | None = None  # count of the newest sample
        codec.commands(Command.START)  # some codecs store what they have requested
        lines = log.form in ("raw", "terminal")  # forms that begin with a whole line
        packets = _cut_last(log.packets(), getattr(codec, "line_end", b"") if lines else b"")
        waiting: list[tuple[Any, int | None, Samples | None]] = []
        for packet, t_ns in packets:
            waiting.append((packet, t_ns, self._feed(packet, t_ns)))
            if codec.spec is not None or len(waiting) > AHEAD:
                break
        if codec.spec is None:
            why = _explain_empty(log, codec, about.codec)
            if codec.stats.intact:
                why = (
                    f"{codec.stats.intact} whole {about.codec} frames, and none describes the "
                    "array: give array=FILE.json in --as, as `tactile-rt describe` writes it"
                )
            raise ConfigError(f"{log.path}: {why}")
        self._packets = chain(waiting, ((p, t_ns, self._feed(p, t_ns)) for p, t_ns in packets))
        self.timed = self._stamped = bool(waiting) and waiting[0][1] is not None
        self._zero = clock_of(waiting[0][1] or 0) if self._stamped else 0
        self._stamper = Stamper(codec, codec.spec, stats, steady=False)
        own_clock = False
        if not self._stamped and codec.tick_ns is not None:
            self.timed = own_clock = True
            self._stamper.clock = DeviceTime(codec.tick_ns, codec.tick_bits)
        self._period_ns = NS_PER_S / codec.spec.rate_hz
        self._passed = 0.0  # periods since the beginning of a log without times
        self.about = replace(
            about, spec=codec.spec, utc_offset_ns=self._zero,
            clock="device" if own_clock else "log",
        )  # fmt: skip

    @property
    def unfinished(self) -> int:
        """Number of bytes after the last sample or line of text."""
        return int(getattr(self._codec, "unfinished", self._rest))

    @property
    def clock_steps(self) -> int:
        """Number of times that the device's own clock went back or restarted."""
        clock = self._stamper.clock
        return clock.steps if isinstance(clock, DeviceTime) else 0

    def _feed(self, packet: Any, t_ns: int | None) -> Samples | None:
        """Feed a packet to the codec, and count corrupt frames and bytes."""
        stats = self._codec.stats
        before = stats.corrupt
        samples = self._codec.feed(packet, t_ns or 0)
        for _ in range(stats.corrupt - before):
            self.corrupt.add(self._at + 1, self._codec.complaint)
        n = len(packet) if isinstance(packet, bytes) else 1
        self._at += n
        self._rest += n
        if samples is not None:
            self.skipped, self._rest = stats.skipped, 0
        return samples

    def __iter__(self) -> Iterator[tuple[Any, int, Chunk | None]]:
        for packet, t_ns, samples in self._packets:
            if t_ns is not None:
                self._now = max(self._now, t_ns - self._zero)
            if samples is None:
                yield packet, self._now, None
                continue
            if not self._stamped:
                self._passed += self._count_periods(samples)
                self._now = max(self._now + 1, round(self._passed * self._period_ns))
            samples.arrived_ns[:] = self._now
            yield packet, self._now, self._stamper.chunk(samples)

    def _count_periods(self, samples: Samples) -> int:
        """Return the number of these samples and of those lost before them."""
        n = len(samples)
        bits, before = self._codec.count_bits, self._count
        if samples.count is None or bits is None:
            return n + int(samples.damaged.sum())
        self._count = int(samples.count[-1])
        if before is None:
            return n
        ahead = (self._count - before) % (1 << bits)
        return ahead if n <= ahead <= 1 << (bits - 1) else n


def _cut_last(
    packets: Iterator[tuple[Any, int | None]], lead: bytes
) -> Iterator[tuple[Any, int | None]]:
    """Yield packets, `lead` before the first; cut the last `LAST` into single bytes."""
    last: deque[tuple[Any, int | None]] = deque()
    for packet, t_ns in packets:
        last.append((lead + packet if lead else packet, t_ns))
        lead = b""
        if len(last) > LAST or not isinstance(packet, bytes):
            yield last.popleft()
    for packet, t_ns in last:
        yield from ((packet[k : k + 1], t_ns) for k in range(len(packet)))


def _explain_empty(log: LineLog, codec: Codec[Any], name: str) -> str:
    stats = codec.stats
    if log.notes and not (stats.intact or stats.corrupt or stats.skipped):
        return log.notes[-1]  # for example, that the log is of another bus
    guess = codec.complaint or (
        f"{stats.intact} intact and {stats.corrupt} damaged frames, {stats.skipped} "
        f"{'bytes' if codec.wire == 'serial' else 'frames'} beside them"
    )
    return f"no whole {name} sample ({guess}); `tactile-rt sniff {log.path}` lists what fits"
