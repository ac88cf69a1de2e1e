"""What every codec promises, as tests: a codec's test module subclasses `CodecContract`.

A case makes the codec afresh each time. `values` are what the device can send exactly; what a
protocol rounds is compared with `tolerance`, in SI units by channel.
"""

import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from bench.drivers.fuzzing import mutate
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import Codec, Command, Samples

T0 = 5_000_000_000


@dataclass(frozen=True)
class CodecCase:
    """One codec under contract."""

    make: Callable[[], Codec[Any]]  # a new codec that knows its spec
    # (n, element, channel) what the emulated device measures, n >= 20, all different
    signal: Callable[[], np.ndarray]
    # by which a decoded value may differ, by channel or for all
    tolerance: float | Sequence[float] = 0.0
    # whether a damaged frame is recognised (a checksum, or a header and footer)
    checked: bool = True
    resync: int = 2  # intact frames that may be lost after damage until samples are decoded again
    # whether after any damage all values are right again from the third sample on
    settles: bool = True


def chunk_of(codec: Codec[Any], signal: np.ndarray, first: int = 0) -> Chunk:
    """The signal as a device with this codec would number and time it."""
    assert codec.spec is not None
    n = len(signal)
    seq = first + np.arange(n, dtype=np.int64)
    period = 1e9 / codec.spec.rate_hz
    valid = np.ones(signal.shape[:2], np.bool_)
    return Chunk(seq, np.round(seq * period).astype(np.int64), signal.astype(np.float32), valid)


def join(codec: Codec[Any], packets: list[Any]) -> Any:
    """Packets as one: bytes, or a list of frames."""
    return b"".join(packets) if codec.wire == "serial" else [f for p in packets for f in p]


def decode(codec: Codec[Any], wire: Any, cuts: Sequence[int] = ()) -> list[Samples]:
    """Feed all of the wire, cut at these places."""
    edges = [0, *sorted(cuts), len(wire)]
    found = (codec.feed(wire[a:b], T0 + a) for a, b in itertools.pairwise(edges) if b > a)
    return [s for s in found if s is not None]


def stacked(samples: list[Samples], what: str) -> np.ndarray | None:
    """One attribute of all samples."""
    parts = [getattr(s, what) for s in samples]
    return None if not parts or parts[0] is None else np.concatenate(parts)


class CodecContract:
    """Subclass it, with an attribute `case`."""

    case: CodecCase

    @pytest.fixture
    def sent(self) -> tuple[Any, np.ndarray]:
        """(what 20 or more samples are on the wire, their values)."""
        codec, signal = self.case.make(), self.case.signal()
        return join(codec, codec.encode(chunk_of(codec, signal))), signal

    def same(self, values: np.ndarray, expected: np.ndarray) -> None:
        assert values.dtype == np.float32
        off = np.abs(values.astype(np.float64) - expected.astype(np.float32))
        assert (off <= np.asarray(self.case.tolerance) + 1e-6 * np.abs(expected)).all(), off.max()

    def test_what_is_encoded_is_decoded(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, signal = sent
        codec = self.case.make()
        samples = decode(codec, wire)
        values = stacked(samples, "values")
        assert values is not None and len(values) >= len(signal) - 1  # the last may wait for more
        self.same(values, signal[: len(values)])
        assert stacked(samples, "valid").all()
        assert codec.stats.corrupt == codec.stats.skipped == codec.stats.incomplete == 0
        assert codec.stats.intact > 0
        count = stacked(samples, "count")
        assert (count is not None) == (codec.count_bits is not None)
        if count is not None:
            assert (np.diff(count) % 2**codec.count_bits == 1).all()
        ticks = stacked(samples, "ticks")
        assert (ticks is not None) == (codec.tick_ns is not None)
        if ticks is not None:
            steps = np.diff(ticks) % 2**codec.tick_bits * codec.tick_ns
            assert np.abs(steps - 1e9 / codec.spec.rate_hz).max() <= codec.tick_ns

    def test_it_does_not_matter_where_the_input_is_cut(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, _ = sent
        self.same_however_cut(wire)
        draw = random.Random(5)
        if self.case.make().wire == "can":
            hurt = [f for f in wire if draw.random() > 0.02]
        else:
            hurt = bytearray(wire)
            for _ in range(4):
                hurt[draw.randrange(len(hurt))] ^= 1 << draw.randrange(8)
            hurt = bytes(hurt)
        self.same_however_cut(hurt)

    def same_however_cut(self, wire: Any) -> None:
        whole = decode(self.case.make(), wire)
        draw = random.Random(1)
        one_by_one = range(1, min(len(wire), 3000))
        for cuts in (one_by_one, *(draw.sample(range(1, len(wire)), 15) for _ in range(5))):
            codec = self.case.make()
            pieces = decode(codec, wire, cuts)
            for what in ("values", "valid", "count", "ticks", "status", "damaged"):
                a, b = stacked(whole, what), stacked(pieces, what)
                assert (a is None) == (b is None)
                assert a is None or np.array_equal(a, b, equal_nan=True)

    def test_damage_is_recognised_and_left_behind(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, signal = sent
        draw = random.Random(2)
        for _ in range(30):
            codec = self.case.make()
            at = draw.randrange(len(wire) // 2)
            if codec.wire == "serial":
                hurt = bytearray(wire)
                hurt[at] ^= 1 << draw.randrange(8)
            else:  # CAN has a checksum of its own: a damaged frame does not arrive
                hurt = [*wire[:at], *wire[at + 1 :]]
            samples = decode(codec, bytes(hurt) if codec.wire == "serial" else hurt)
            values = stacked(samples, "values")
            assert values is not None and len(values) >= len(signal) - 2 - self.case.resync
            if self.case.checked and codec.wire == "serial":
                # what comes through came so: nothing damaged is delivered
                near = np.abs(values[:, None] - signal[None].astype(np.float32))
                allowed = np.asarray(self.case.tolerance) + 1e-6 * np.abs(signal[None])
                usable = stacked(samples, "valid").all(axis=1)
                assert (near <= allowed).all(axis=(2, 3)).any(axis=1)[usable].all()

    def test_it_finds_back_after_any_damage(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, signal = sent
        draw = random.Random(6)
        exact = self.case.make().wire == "serial" and self.case.settles
        for _ in range(40 if exact else 0):
            codec = self.case.make()
            for packet in mutations(wire, draw, 500):
                codec.feed(packet, T0)
            samples = decode(codec, wire)
            values, least = stacked(samples, "values"), len(signal) - 2
            assert values is not None and len(values) >= least
            off = np.abs(values[-least:] - signal[len(signal) - least :].astype(np.float32))
            near = off <= np.asarray(self.case.tolerance) + 1e-6 * np.abs(signal[-least:])
            assert (near.all(axis=2) | ~stacked(samples, "valid")[-least:]).all()

    def test_no_input_raises_or_piles_up(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, _ = sent
        codec = self.case.make()
        draw = random.Random(3)
        for packet in mutations(wire, draw, 100_000):
            samples = codec.feed(packet, T0)
            if samples is not None:
                assert samples.values.shape[1:] == codec.spec.shape
                assert samples.valid.shape == samples.values.shape[:2]
                assert np.isfinite(samples.values[samples.valid]).all()
        assert held(codec) < 200_000

    def test_what_no_wire_can_carry_is_invalid_or_at_its_end(self) -> None:
        device, signal = self.case.make(), self.case.signal().astype(float)
        least, most = signal[:, 0, 0].min(), signal[:, 0, 0].max()
        signal[1:6, 0, 0] = np.nan, 1e9, 1e12, -1e9, -1e12
        samples = decode(self.case.make(), join(device, device.encode(chunk_of(device, signal))))
        values, valid = stacked(samples, "values"), stacked(samples, "valid")
        assert np.isfinite(values[valid]).all()
        _, _, high, higher, low, lower = values[:6, 0, 0]  # a wire's end, or the number itself
        assert not valid[2:4, 0].any() or higher >= high > most - 0.01 * abs(most)
        assert not valid[4:6, 0].any() or lower <= low < least + 0.01 * abs(least) + 1e-6

    def test_frames_of_others_are_passed_over(self, sent: tuple[Any, np.ndarray]) -> None:
        codec = self.case.make()
        if codec.wire == "can":
            others = [f._replace(extended=not f.extended) for f in sent[0][:9]]
            assert codec.feed([*others, sent[0][0]._replace(remote=True)], T0) is None
            assert (codec.stats.skipped, codec.stats.corrupt) == (len(others) + 1, 0)
            short = [f._replace(data=f.data[:-1]) for f in sent[0]]
            codec.feed([*sent[0], *short, *sent[0]], T0)
            lost = codec.stats.skipped + codec.stats.corrupt + codec.stats.incomplete
            assert lost > len(others) + 1

    def test_respond_takes_anything(self, sent: tuple[Any, np.ndarray]) -> None:
        codec = self.case.make()
        draw = random.Random(4)
        for packet in mutations(sent[0], draw, 10_000):
            assert isinstance(codec.respond(packet), bytes if codec.wire == "serial" else Sequence)

    def test_commands_are_packets(self) -> None:
        codec = self.case.make()
        for command in Command:
            for step in codec.commands(command):
                assert isinstance(step.send, bytes if codec.wire == "serial" else Sequence)
                assert step.timeout_s > 0 and step.pause_s >= 0

    def test_forgetting_is_a_new_start(self, sent: tuple[Any, np.ndarray]) -> None:
        wire, _ = sent
        codec = self.case.make()
        codec.feed(wire[: len(wire) // 2 - 1], T0)
        codec.forget()
        again, fresh = decode(codec, wire), decode(self.case.make(), wire)
        assert np.array_equal(stacked(again, "values"), stacked(fresh, "values"))


def mutations(wire: Any, draw: random.Random, size: int) -> list[Any]:
    """At least `size` bytes of damaged, shuffled, repeated and foreign input, in packets."""
    packets: list[Any] = []
    done = 0
    while done < size:
        packet, length = mutate(wire, draw)
        packets.append(packet)
        done += length + 1
    return packets


def held(thing: object, depth: int = 4) -> int:
    """Bytes in the buffers and lists that an object keeps."""
    if isinstance(thing, bytes | bytearray | str):
        return len(thing)
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    if depth and isinstance(thing, list | tuple | set | dict):
        items = thing.items() if isinstance(thing, dict) else thing
        return 8 * len(thing) + sum(held(x, depth - 1) for x in items)
    return (
        sum(held(x, depth - 1) for x in vars(thing).values())
        if depth and hasattr(thing, "__dict__")
        else 8
    )
