"""Damaged, cut, repeated and foreign input for every codec, and how soon it recovers.

At length, one codec after another (`make fuzz`):

python -m bench.drivers.fuzzing [BYTES] [CODEC ...]     e.g. 1000000 "serial bota" "can xela"
"""

import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame, Codec, Samples
from tactile_rt.drivers.opening import make_codec
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sources.synthetic import synthetic_spec

QUICK, WHOLE = 100_000, 10_000_000  # bytes for each codec
SAMPLES = 40
TRIALS = 60
LOOK_EVERY = 500  # packets between two looks at what a codec holds
CUTS = 2000  # packets that are fed cut otherwise, too
HEADERLESS = ("ati_485", "anyskin", "hx711_whisker")  # begin by alignment, not by a header
HELD_MOST = 200_000  # bytes: a frame of the longest length that a header can name, and some
# What each unit's values may be: within every device's range.
RANGES = {"N": 0.05, "N m": 5e-4, "T": 3e-3, "K": 10.0, "V": 5e-3, "Pa": 100.0, "rad": 1.0}
OFFSETS = {"K": 297.0, "1": 3000.0}
COLUMNS = "A0.fx,A0.fy,B1.fx,B1.fy"
DBC = """VERSION ""
BU_: Board Host
BO_ 256 Pad: 8 Board
 SG_ X : 0|16@1- (0.001,0) [-32|32] "" Host
 SG_ Y : 16|16@1- (0.001,0) [-32|32] "" Host
"""
MAPPING = """dbc = "pad.dbc"
name = "pad"
rate_hz = 100.0
channel = [{ name = "fx", unit = "N" }, { name = "fy", unit = "N" }]
element = [{ name = "A0", grid = [0, 0], signals = { fx = "Pad.X", fy = "Pad.Y" } }]
"""


@dataclass(frozen=True)
class Fuzzed:
    """What fuzzing one codec showed.

    Attributes:
        codec: The codec's wire and name.
        bytes: Number of mutated bytes that were fed.
        exceptions: Number of exceptions that the codec raised.
        held: Bytes that the codec kept at most.
        uneven: Whether another cut of the same input gave another result.
        seconds: Processor time of it all, s.
    """

    codec: str
    bytes: int
    exceptions: int
    held: int
    uneven: bool
    seconds: float


@contextmanager
def all_codecs() -> Iterator[dict[str, Callable[[], Codec[Any]]]]:
    """``wire name``: what makes it, for all codecs whose extra is installed."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "pad.dbc").write_text(DBC)
        (Path(folder) / "pad.toml").write_text(MAPPING)
        options = {
            "ascii_line": {"columns": COLUMNS},
            "can-dbc": {"mapping": str(Path(folder) / "pad.toml")},
        }

        def maker(wire: str, name: str) -> Callable[[], Codec[Any]]:
            def make() -> Codec[Any]:
                codec = make_codec(wire, name, options.get(name, {}))
                if codec.spec is None:
                    codec.spec = synthetic_spec(5, 6, 1000.0)
                return codec

            return make

        found = {}
        for wire, name in CODECS:
            make = maker(wire, name)
            try:
                make()
            except ConfigError:
                continue  # what it needs is not installed
            found[f"{wire} {name}"] = make
        yield found


def wire_of(codec: Codec[Any]) -> list[Any]:
    """What a device sends for some samples, all different: a packet for each."""
    spec = codec.spec
    assert spec is not None
    draw = np.random.default_rng(1)
    span = np.array([RANGES.get(unit, 2000.0) for unit in spec.units])
    middle = np.array([OFFSETS.get(unit, 0.0) for unit in spec.units])
    values = middle + span * draw.uniform(-1, 1, (SAMPLES, *spec.shape))
    seq = np.arange(SAMPLES, dtype=np.int64)
    t_ns = np.round(seq * (1e9 / spec.rate_hz)).astype(np.int64)
    valid = np.ones(values.shape[:2], np.bool_)
    return codec.encode(Chunk(seq, t_ns, values.astype(np.float32), valid))


def mutate(wire: Any, draw: random.Random) -> tuple[Any, int]:
    """A piece of a line's traffic with something wrong in it, as a rule, and its size in bytes."""
    start = draw.randrange(len(wire))
    part = wire[start : start + draw.randrange(1, 400)]
    if isinstance(wire, bytes):
        hurt = bytearray(part)
        for _ in range(draw.choice((0, 0, 1, 1, 3, 40))):
            hurt[draw.randrange(len(hurt))] = draw.randrange(256)
        if draw.random() < 0.3:
            hurt += draw.randbytes(draw.randrange(60))
        if draw.random() < 0.2:
            del hurt[draw.randrange(len(hurt)) :]
        return bytes(hurt), len(hurt)
    frames = list(part)
    for k, frame in enumerate(frames):
        luck = draw.random()
        if luck < 0.2:
            frames[k] = frame._replace(data=draw.randbytes(draw.randrange(9)))
        elif luck < 0.25:
            frames[k] = CanFrame(draw.randrange(2048), frame.data, draw.random() < 0.5)
        elif luck < 0.3:
            frames[k] = frame._replace(remote=True, data=b"")
        elif luck < 0.35:
            frames[k] = frame._replace(data=frame.data[: draw.randrange(9)])
    if draw.random() < 0.2:
        draw.shuffle(frames)
    return frames, sum(2 + len(frame.data) for frame in frames)


def fuzz(name: str, make: Callable[[], Codec[Any]], size: int) -> Fuzzed:
    """Feed so many mutated bytes; half-way along, the same cut in two ways."""
    draw = random.Random(3)
    codec, other = make(), make()
    wire = _join(codec, wire_of(make()))
    fed, exceptions, most, packets, uneven = 0, 0, 0, 0, False
    began = time.process_time()
    while fed < size:
        packet, length = mutate(wire, draw)
        fed += length
        packets += 1
        whole = pieces = None
        try:
            whole = codec.feed(packet, fed)
            if packets <= CUTS:  # a second decoder would double the cost of all
                cut = draw.randrange(len(packet) + 1)
                pieces = [other.feed(part, fed) for part in (packet[:cut], packet[cut:])]
                uneven = uneven or not _same(whole, pieces)
        except Exception:  # that there is none is what is measured
            exceptions += 1
        if packets % LOOK_EVERY == 0:
            most = max(most, _held(codec))
    most = max(most, _held(codec))
    return Fuzzed(name, fed, exceptions, most, uneven, time.process_time() - began)


def fuzzing(quick: bool) -> list[Record]:
    """Every codec: exceptions, memory, cuts; every serial one: how soon it recovers or locks."""
    size = QUICK if quick else WHOLE
    with all_codecs() as codecs:
        found = [fuzz(name, make, size) for name, make in codecs.items()]
        serial = {n.split()[1]: make for n, make in codecs.items() if n.startswith("serial")}
        framed = {n: _recovery(make) for n, make in serial.items() if n not in HEADERLESS}
        locked = {n: _locking(make) for n, make in serial.items() if n in HEADERLESS}
    how = f"{len(found)} codecs, {size:,} mutated bytes each"
    most = max(found, key=lambda f: f.held)
    names = ", ".join(f.codec for f in found if f.uneven) or "none"
    slowest = min(found, key=lambda f: f.bytes / f.seconds)
    return [
        Record("drivers.fuzz.exceptions", sum(f.exceptions for f in found), "", "== 0", "", how),
        Record(
            "drivers.fuzz.held", most.held, "bytes", f"<= {HELD_MOST}", "of incomplete frames",
            f"{most.codec}, the most of all; {how}",
        ),
        Record(
            "drivers.fuzz.uneven", sum(f.uneven for f in found), "codecs", "== 0",
            "other samples when the same bytes come cut otherwise",
            f"{CUTS} packets for each codec: {names}",
        ),
        Record(
            "drivers.fuzz.slowest", slowest.bytes / slowest.seconds / 1e6, "MB/s",
            how=f"{slowest.codec}; mutation included",
        ),
        Record(
            "drivers.fuzz.resync", max(framed.values()), "frames", "<= 2",
            "whole frames lost after a damaged one",
            f"worst of {TRIALS} damages each: {', '.join(f'{n} {k}' for n, k in framed.items())}",
        ),
        Record(
            "drivers.fuzz.lock", max(locked.values()), "frames", "<= 8",
            "frames until the first right sample, beginning anywhere; no header",
            f"worst of {TRIALS} each: {', '.join(f'{n} {k}' for n, k in locked.items())}",
        ),
    ]  # fmt: skip


def _recovery(make: Callable[[], Codec[Any]]) -> int:
    """Whole frames lost after a damaged one, at most."""
    draw = random.Random(5)
    packets = wire_of(make())
    right = _values(make().feed(_join(make(), packets), 0))
    worst = 0
    for _ in range(TRIALS):
        hit = draw.randrange(5, SAMPLES // 2)
        hurt = bytearray(packets[hit])
        if draw.random() < 0.3:
            del hurt[draw.randrange(len(hurt)) :]
        elif draw.random() < 0.3:
            hurt[draw.randrange(len(hurt)) : 0] = draw.randbytes(draw.randrange(1, 20))
        else:
            hurt[draw.randrange(len(hurt))] ^= 1 << draw.randrange(8)
        wire = b"".join((*packets[:hit], bytes(hurt), *packets[hit + 1 :]))
        came = set(_values(make().feed(wire, 0)))
        # a codec may have to see the next frame before it gives out one
        worst = max(worst, sum(right[k] not in came for k in range(hit + 1, len(right))))
    return worst


def _locking(make: Callable[[], Codec[Any]]) -> int:
    """Whole frames that pass before the first right sample, at most."""
    draw = random.Random(6)
    packets = wire_of(make())
    wire = _join(make(), packets)
    size = len(wire) // len(packets)
    places = {values: k for k, values in enumerate(_values(make().feed(wire, 0)))}
    worst = 0
    for _ in range(TRIALS):
        begin = draw.randrange(size * 8)
        first = -(-begin // size)  # whole frame from here
        codec, fed = make(), begin
        while True:  # byte by byte: how many frames had come when the first was right?
            step = wire[fed : fed + 1]
            if not step:
                return SAMPLES
            fed += 1
            if any(values in places for values in _values(codec.feed(step, 0))):
                break
        worst = max(worst, -(-fed // size) - first)
    return worst


def _values(samples: Samples | None) -> list[bytes]:
    return [] if samples is None else [one.tobytes() for one in samples.values]


def _join(codec: Codec[Any], packets: Sequence[Any]) -> Any:
    return b"".join(packets) if codec.wire == "serial" else [f for p in packets for f in p]


def _same(whole: Samples | None, pieces: Sequence[Samples | None]) -> bool:
    """Whether both are the same samples; arrival times apart."""
    for what in ("values", "valid", "damaged", "count", "ticks", "status"):
        parts = [getattr(piece, what) for piece in pieces if piece is not None]
        mine = None if whole is None else getattr(whole, what)
        theirs = None if not parts or parts[0] is None else np.concatenate(parts)
        if mine is None or theirs is None:
            if mine is not theirs:
                return False
        elif not np.array_equal(mine, theirs, equal_nan=what == "values"):
            return False
    return True


def _held(thing: object, depth: int = 4) -> int:
    """Bytes in the buffers and lists that an object keeps."""
    if isinstance(thing, bytes | bytearray | str):
        return len(thing)
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    if depth and isinstance(thing, list | tuple | set | dict):
        items = thing.items() if isinstance(thing, dict) else thing
        return 8 * len(thing) + sum(_held(x, depth - 1) for x in items)
    if depth and hasattr(thing, "__dict__"):
        return sum(_held(x, depth - 1) for x in vars(thing).values())
    return 8


def main() -> int:
    """Print a line for each codec; 1 if one raised, kept too much or depends on cuts."""
    size = int(sys.argv[1]) if len(sys.argv) > 1 else WHOLE
    bad = 0
    say = sys.stdout.write
    say(f"{'codec':<22}{'bytes':>12}{'exceptions':>12}{'most held':>11}{'cuts':>7}{'CPU s':>8}\n")
    with all_codecs() as codecs:
        for name, make in codecs.items():
            if sys.argv[2:] and name not in sys.argv[2:]:
                continue
            found = fuzz(name, make, size)
            cuts = "differ" if found.uneven else "same"
            say(
                f"{name:<22}{found.bytes:>12}{found.exceptions:>12}{found.held:>11}{cuts:>7}"
                f"{found.seconds:>8.1f}\n"
            )
            sys.stdout.flush()
            bad += bool(found.exceptions or found.held > HELD_MOST or found.uneven)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main())
