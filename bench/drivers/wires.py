"""What acquisition costs, what it adds, what it loses: serial and slcan, over ptys."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.drivers.metronome import Beat, Sent, play
from bench.drivers.readers import Came, read_bare, read_sources
from bench.processes import Helper
from tactile_rt.core.stream import Chunk, SourceStats
from tactile_rt.drivers.clocks import Stamper
from tactile_rt.drivers.opening import make_codec
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sources.synthetic import synthetic_spec

READERS: dict[str, float | None] = {"thread": None, "one": 0.0, "gather": 0.001}
HOW = {
    "thread": "a thread for each device", "one": "one thread for all",
    "gather": "one thread for all, handed on each millisecond",
}  # fmt: skip
BARS = {  # % of a core, and that by a thread for each
    ("one", "together"): ("<= 13", "<= 0.45"), ("one", "apart"): ("<= 15", "<= 0.55"),
    ("gather", "together"): ("<= 13.5", ""), ("gather", "apart"): ("<= 13.5", ""),
}  # fmt: skip
READERS_QUICK_S, READERS_S, QUICK_ROUNDS, ROUNDS = 3.0, 8.0, 1, 5
MANY = 16

DEVICES_PPM = (0.0, 200.0, -200.0, 50.0)  # the clocks of the four devices
SERIAL_QUICK_S, SERIAL_S = 8.0, 600.0
CAN_QUICK_S, CAN_S, FAST_QUICK_S, FAST_S = 5.0, 600.0, 3.0, 20.0
SETTLED_S = 30.0  # until the clock must be right
WARM = 3000  # samples
SATURATED_HZ = 145.0  # of 62 frames: 9,000 frames/s, as many as 1 Mbit/s carries


class _Result(NamedTuple):
    sent: list[Sent]
    came: list[Came]
    share: float  # of a core
    bare: list[Came]
    bare_share: float


def _run(beat: Beat) -> _Result:
    """Play a beat to our sources and, where it has twins, to a bare reader."""
    with Helper(play, beat) as device:
        addresses = device.hear()
        query = "&".join(f"{k}={v}" for k, v in {"codec": "native", **beat.options}.items())
        urls, paths = [f"{address}?{query}" for address, _ in addresses], [p for _, p in addresses]
        if not beat.twins:
            with Helper(read_sources, urls, beat.samples) as ours:
                ours.hear()
                sent = device.hear(60 + 10 * beat.seconds if beat.fast else beat.seconds)
                came, share = ours.hear()
            return _Result(sent, came, share, [], 0.0)
        with Helper(read_bare, paths, beat.samples) as bare:
            bare.hear()
            with Helper(read_sources, urls, beat.samples) as ours:
                ours.hear()
                sent = device.hear(beat.seconds)
                came, share = ours.hear()
            bare_came, bare_share = bare.ask(sent[0].packet)
        return _Result(sent, came, share, bare_came, bare_share)


def serial(quick: bool) -> list[Record]:
    """Four devices of 1 kHz x 869 B, and four twins read by `os.read` alone."""
    seconds = SERIAL_QUICK_S if quick else SERIAL_S
    beat = Beat("serial", DEVICES_PPM, 35, 1000.0, seconds, twins=True)
    sent, came, share, bare, bare_share = _run(beat)
    ours_us = np.concatenate([_late(c, s.at_ns) for c, s in zip(came, sent, strict=True)])
    bare_us = np.concatenate([_late(c, s.twin_ns) for c, s in zip(bare, sent, strict=True)])
    p50, p99 = np.percentile(ours_us, (50, 99)).tolist()
    bare50, bare99 = np.percentile(bare_us, (50, 99)).tolist()
    size, n = sent[0].packet, len(came)
    what = f"{n} devices x {beat.rate_hz:g} Hz x {size} B over ptys, {seconds:g} s"
    side = "a thread for each device; beside it, in a process of its own, os.read alone"
    reads = sum(c.reads for c in came) / sum(len(c.seq) for c in came)
    samples = n * beat.rate_hz
    return [
        Record("drivers.serial.lost", _lost(sent, came), "samples", "== 0", "", what),
        Record(
            "drivers.serial.cpu", 100 * share, "% of a core", "<= 15",
            f"os.read alone: {100 * bare_share:.1f}",
            f"{what}; process time of a thread for each, {1e6 * share / samples:.0f} us and "
            f"{reads:.2f} reads a sample",
        ),
        Record(
            "drivers.serial.added_p50", p50 - bare50, "us", "<= 100",
            f"from the device's write to the caller: {p50:.0f}, os.read alone {bare50:.0f}", side,
        ),
        Record(
            "drivers.serial.p99_over_bare", p99 / bare99, "x", "<= 2",
            f"{p99:.0f} us, os.read alone {bare99:.0f}", side,
        ),
        Record(
            "drivers.serial.warm", _warm_us(), "us/sample", "", "no cold caches",
            "the same samples from memory, one after another: decoding, numbering, timing",
        ),
        *_clock(sent, came, seconds),
    ]  # fmt: skip


def readers(quick: bool) -> list[Record]:
    """The ways to read four devices of 1 kHz x 869 B, one after the other in turn; then sixteen."""
    seconds, rounds = (READERS_QUICK_S, QUICK_ROUNDS) if quick else (READERS_S, ROUNDS)
    shares: dict[tuple[str, str], list[float]] = {}
    late: dict[tuple[str, str], list[float]] = {}
    lost = 0
    for _ in range(rounds):
        for phase in ("together", "apart"):
            for name, gather_s in READERS.items():
                share, p99, gone = _read_by(gather_s, 4, phase, seconds)
                shares.setdefault((name, phase), []).append(100 * share)
                late.setdefault((name, phase), []).append(p99)
                lost += gone
    many, many_p99, gone = _read_by(0.0, MANY, "apart", seconds)
    records = [
        Record("drivers.readers.lost", lost + gone, "samples", "== 0", "", "of all these runs")
    ]
    for (name, phase), found in shares.items():
        bar, ratio_bar = BARS.get((name, phase), ("", ""))
        median = float(np.median(found))
        by_threads = np.array(shares["thread", phase])
        ratio = float(np.median(np.array(found) / by_threads))
        p99 = float(np.median(late[name, phase]))
        told = (
            f"{HOW[name]}, 4 devices x 1 kHz x 869 B, samples {phase}; median of {rounds} x "
            f"{seconds:g} s in turn, {min(found):.1f} to {max(found):.1f}; p99 of the latency "
            f"{p99:.0f} us"
        )
        records.append(
            Record(f"drivers.readers.{name}_{phase}", median, "% of a core", bar, "", told)
        )
        if ratio_bar:
            threads_p99 = float(np.median(late["thread", phase]))
            records += [
                Record(
                    f"drivers.readers.{name}_{phase}_ratio", ratio, "x", ratio_bar,
                    HOW["thread"], "of the same round; median",
                ),
                Record(
                    f"drivers.readers.{name}_{phase}_p99", p99 / threads_p99, "x", "<= 1",
                    f"{HOW['thread']}: {threads_p99:.0f} us", f"{p99:.0f} us",
                ),
            ]  # fmt: skip
    what = f"{MANY} devices x 1 kHz x 869 B, one thread; p99 of the latency {many_p99:.0f} us"
    return [*records, Record("drivers.readers.many", 100 * many, "% of a core", "<= 50", "", what)]


def _read_by(
    gather_s: float | None, devices: int, phase: str, seconds: float
) -> tuple[float, float, int]:
    """(share of a core, p99 of the latency in us, samples lost) of one way to read them."""
    beat = Beat("serial", (0.0,) * devices, 35, 1000.0, seconds, phase=phase)
    with Helper(play, beat) as device:
        urls = [f"{address}?codec=native" for address, _ in device.hear()]
        with Helper(read_sources, urls, beat.samples, gather_s) as ours:
            ours.hear()
            sent = device.hear(beat.seconds)
            came, share = ours.hear()
    late = np.concatenate([_late(c, s.at_ns) for c, s in zip(came, sent, strict=True)])
    return share, float(np.percentile(late, 99)), _lost(sent, came)


def _warm_us() -> float:
    """CPU time of decoding, numbering and timing a sample when nothing comes between, us."""
    encoder, decoder = (make_codec("serial", "native", {}) for _ in range(2))
    spec = encoder.spec = decoder.spec = synthetic_spec(35, 6, 1000.0)
    seq = np.arange(WARM, dtype=np.int64)
    values = np.random.default_rng(0).normal(0, 1e-3, (WARM, *spec.shape)).astype(np.float32)
    chunk = Chunk(seq, 1_000_000 * seq, values, np.ones(values.shape[:2], np.bool_))
    packets = encoder.encode(chunk)
    taken = []
    for _ in range(5):
        decoder.forget()
        stamper = Stamper(decoder, spec, SourceStats())
        began = time.thread_time()
        for k, packet in enumerate(packets):
            samples = decoder.feed(packet, 10**9 + 1_000_000 * k)
            assert samples is not None
            stamper.chunk(samples)
        taken.append(1e6 * (time.thread_time() - began) / WARM)
    return float(np.median(taken))


def _clock(sent: list[Sent], came: list[Came], seconds: float) -> list[Record]:
    """How well the drifting clocks of these devices were followed."""
    after = SETTLED_S if seconds > 2 * SETTLED_S else seconds / 2
    errors = []
    for s, c in zip(sent, came, strict=True):
        late = c.seq > after * len(s.due_ns) / seconds
        errors.append(np.abs(c.told_ns - s.due_ns[c.seq])[late])
    off = [
        abs(c.drift_ppm - 1e6 * (1 / (1 + 1e-6 * ppm) - 1))
        for c, ppm in zip(came, DEVICES_PPM, strict=True)
    ]
    how = f"clocks {', '.join(f'{p:+g}' for p in DEVICES_PPM)} ppm fast, over the ptys"
    whole = seconds >= SERIAL_S
    return [
        Record(
            "drivers.clock.live_error_p99", float(np.percentile(np.concatenate(errors), 99)) / 1e6,
            "ms", "<= 1", f"after {after:g} s", how,
        ),
        Record(
            "drivers.clock.live_drift_off", max(off), "ppm", "<= 2" if whole else "",
            f"after {seconds:g} s; the bar is for ten minutes", f"{how}; worst of {len(off)}",
        ),
    ]  # fmt: skip


def can(quick: bool) -> list[Record]:
    """A saturated bus, and as many frames as come through, behind slcan."""
    seconds = CAN_QUICK_S if quick else CAN_S
    beat = Beat("slcan", (0.0,), 30, SATURATED_HZ, seconds)
    sent, came, share, *_ = _run(beat)
    frames = sent[0].packet
    what = f"native int16, 30 x 6, {frames} frames a sample, slcan over a pty"
    records = [
        Record(
            "drivers.can.saturated_lost", _lost(sent, came), "samples", "== 0",
            "1 Mbit/s carries some 9,000 frames/s",
            f"{what}; {frames * SATURATED_HZ:.0f} frames/s for {seconds:g} s",
        ),
        Record("drivers.can.saturated_cpu", 100 * share, "% of a core", how=what),
    ]  # fmt: skip
    most = FAST_QUICK_S if quick else FAST_S
    beat = Beat("slcan", (0.0,), 30, 1000.0, most, fast=True)
    sent, came, share, *_ = _run(beat)
    at = came[0].at_ns
    rate = frames * (len(at) - 1) / (at[-1] - at[0]) * 1e9
    return [
        *records,
        Record(
            "drivers.can.frames_per_s", rate, "frames/s", ">= 20000",
            "python-can's slcan: 5,500", f"{what}; {frames * len(at)} frames as fast as they go",
        ),
        Record("drivers.can.fast_lost", _lost(sent, came), "samples", "== 0", "", what),
        Record(
            "drivers.can.frames_per_cpu_s", rate / share, "frames/s of CPU", how="process time",
        ),
    ]  # fmt: skip


def _late(came: Came, at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n,) from the device's write to the caller, us; without the first half second."""
    late = (came.at_ns - at_ns[came.seq]) / 1e3
    kept: NDArray[np.float64] = late[min(500, len(late) // 4) :]
    return kept


def _lost(sent: list[Sent], came: list[Came]) -> int:
    """Samples that were sent and did not come, or came wrongly numbered; refusals too."""
    lost = 0
    for s, c in zip(sent, came, strict=True):
        lost += s.refused + len(np.setxor1d(np.arange(len(s.at_ns)), c.seq))
        lost += c.stats.missing + c.stats.corrupt
    return lost
