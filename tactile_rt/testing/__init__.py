"""Helpers for your own tests: a small array, chunks of any signal, a source without a device, and
emulated devices on real lines.

spec = small_spec()
source = ArraySource(spec, cut_chunks(signal, spec.rate_hz))

with FakeSerial(signal, "native", spec=spec) as device, open_source(device.url) as source:
    chunk = source.read(timeout=1.0)
    device.unplug()

`tactile_rt.testing.fixtures` provides the devices as fixtures.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedDevice, EmulatedSerial
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.synthetic import synthetic_spec

__all__ = ["ArraySource", "FakeCan", "FakeSerial", "cut_chunks", "small_spec"]


def small_spec(elements: int = 3, rate_hz: float = 1000.0) -> ArraySpec:
    """Make the spec of elements in a row, 2 mm apart. Each has a force and a moment."""
    return ArraySpec(
        name="small",
        elements=tuple(f"A{i}" for i in range(elements)),
        grid=tuple((0, i) for i in range(elements)),
        positions=tuple((0.0, 0.002 * i, 0.0) for i in range(elements)),
        orientations=((1.0, 0.0, 0.0, 0.0),) * elements,
        channels=("fy", "mz"),
        units=("N", "N m"),
        rate_hz=rate_hz,
        frame="mount",
    )


def cut_chunks(
    values: ArrayLike, rate_hz: float, samples: int = 9, start_ns: int = 0
) -> list[Chunk]:
    """Cut a signal into chunks of evenly spaced samples that are all valid.

    Args:
        values: The signal, (n, element, channel), SI units.
        samples: Samples per chunk; the last chunk may be shorter.
    """
    signal = np.asarray(values, dtype=np.float32)
    seq = np.arange(len(signal), dtype=np.int64)
    t_ns = start_ns + np.round(seq * (NS_PER_S / rate_hz)).astype(np.int64)
    if not len(signal):
        return []
    whole = Chunk(seq, t_ns, signal, np.ones(signal.shape[:2], dtype=np.bool_))
    return [whole.select(slice(i, i + samples)) for i in range(0, len(signal), samples)]


class ArraySource(Source):
    """Source that delivers chunks from memory, one per read, without waiting.

    Args:
        spec: Description of the samples.
        chunks: The chunks to deliver, in order.
        live: True to act as a device, which a `Session` reads in a thread of its own.

    Raises:
        ValueError: A chunk does not have the shape of `spec`.
    """

    def __init__(self, spec: ArraySpec, chunks: Sequence[Chunk], live: bool = False) -> None:
        super().__init__(spec)
        self.live = live
        for chunk in chunks:
            if chunk.values.shape[1:] != spec.shape:
                raise ValueError(f"chunk of shape {chunk.values.shape}, not (n, *{spec.shape})")
        self._left = list(chunks)[::-1]  # reversed: the next chunk is the last item

    def read(self, timeout: float | None = None) -> Chunk | None:
        if not self._left:
            raise EndOfStream
        chunk = self._left.pop()
        self.stats.delivered += len(chunk)
        return chunk

    def close(self) -> None:
        self._left.clear()


class _SignalDevice(EmulatedDevice):
    """Emulated device that measures a given signal, on a line of unlimited speed."""

    paced = False

    def __init__(
        self,
        signal: ArrayLike | Source,
        codec: str = "native",
        *,
        spec: ArraySpec | None = None,
        **further: Any,
    ) -> None:
        source = _make_source(signal, self.wire, codec, spec, further)
        super().__init__(source, codec, **further)


class FakeSerial(_SignalDevice, EmulatedSerial):
    """Emulated device on a serial port, plugged in during its ``with`` block. See
    `EmulatedSerial`. The line's speed is unlimited, unless an option ``baud`` gives it.

    Args:
        signal: The measured signal: (n, element, channel) in SI units, or a source.
        spec: The array, if neither the codec nor a source defines it.
        further: Options of `EmulatedSerial`.
    """


class FakeCan(_SignalDevice, EmulatedCan):
    """Emulated device on a CAN bus, plugged in during its ``with`` block. See `EmulatedCan`. The
    bus's speed is unlimited, unless an option ``bitrate`` gives it.

    The arguments are those of `FakeSerial`; `further` are options of `EmulatedCan`.
    """


def _make_source(
    signal: ArrayLike | Source, wire: str, codec: str, spec: ArraySpec | None, further: Any
) -> Source:
    if isinstance(signal, Source):
        return signal
    values = np.asarray(signal, np.float32)
    if values.ndim != 3:
        raise ConfigError(f"a signal must be (n, element, channel), not {values.shape}")
    elements, channels = values.shape[1:]
    spec = spec or make_codec(wire, codec, dict(further.get("options") or {})).spec
    spec = spec or synthetic_spec(elements, channels, 1000.0)
    return ArraySource(spec, cut_chunks(values, spec.rate_hz))
