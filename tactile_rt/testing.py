"""For your own tests: a small array, chunks of any signal, a source that needs no device, and
devices on real lines that need no hardware.

spec = small_spec()
source = ArraySource(spec, cut(signal, spec.rate_hz))

with FakeSerial(signal, "native", spec=spec) as device, open_source(device.url) as source:
    chunk = source.read(timeout=1.0)
    device.unplug()

`tactile_rt.pytest_fixtures` has them as fixtures.
"""

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import quote, urlencode

import numpy as np
from numpy.typing import ArrayLike

from tactile_rt.stream import ArraySpec, Chunk, ConfigError, EndOfStream, Source
from tactile_rt.timebase import NS_PER_S

if TYPE_CHECKING:  # a robot that only imports us has no need of them, nor Windows a pty
    from tactile_rt.drivers.codec import Codec
    from tactile_rt.drivers.emulation.endpoints import Endpoint
    from tactile_rt.drivers.emulation.faults import FaultSchedule

__all__ = ["ArraySource", "FakeCan", "FakeSerial", "cut", "small_spec"]


def small_spec(elements: int = 3, rate_hz: float = 1000.0) -> ArraySpec:
    """A row of elements 2 mm apart that measure one force and one moment."""
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


def cut(values: ArrayLike, rate_hz: float, samples: int = 9, start_ns: int = 0) -> list[Chunk]:
    """Cut a signal into chunks of evenly spaced, wholly valid samples.

    Args:
        values: (n, element, channel) SI.
        rate_hz: sample rate.
        samples: of each chunk; the last one may be shorter.
        start_ns: time of the first sample.
    """
    signal = np.asarray(values, dtype=np.float32)
    seq = np.arange(len(signal), dtype=np.int64)
    t_ns = start_ns + np.round(seq * (NS_PER_S / rate_hz)).astype(np.int64)
    return [
        Chunk(
            seq[i : i + samples],
            t_ns[i : i + samples],
            signal[i : i + samples],
            np.ones(signal[i : i + samples].shape[:2], dtype=np.bool_),
        )
        for i in range(0, len(signal), samples)
    ]


class ArraySource(Source):
    """Chunks in memory as a source: one per read, at once, then the end.

    Args:
        spec: what the samples are.
        chunks: what to deliver.
        live: claim to be a device, so that a `Session` reads in a thread of its own.

    Raises:
        ValueError: a chunk is not of `spec.shape`.
    """

    def __init__(self, spec: ArraySpec, chunks: Sequence[Chunk], live: bool = False) -> None:
        super().__init__(spec)
        self.live = live
        for chunk in chunks:
            if chunk.values.shape[1:] != spec.shape:
                raise ValueError(f"chunk of shape {chunk.values.shape}, not (n, *{spec.shape})")
        self._left = list(chunks)[::-1]  # the next one last

    def read(self, timeout: float | None = None) -> Chunk | None:
        if not self._left:
            raise EndOfStream
        chunk = self._left.pop()
        self.stats.delivered += len(chunk)
        return chunk

    def close(self) -> None:
        self._left.clear()


class _FakeDevice:
    """An emulated device; a context manager.

    Attributes:
        codec: what it speaks, with what hosts have commanded.
        emulator: it itself, once entered; its `log` tells what it did with each sample.
    """

    wire: str

    def __init__(
        self,
        signal: ArrayLike | Source,
        codec: str = "native",
        *,
        spec: ArraySpec | None = None,
        options: dict[str, str] | None = None,
        faults: "FaultSchedule | None" = None,
        pace: str = "realtime",
        **emulator: Any,
    ) -> None:
        from tactile_rt.drivers.emulation.emulator import Emulator
        from tactile_rt.drivers.opening import make_codec
        from tactile_rt.drivers.synthetic import synthetic_spec

        self._name, self._options = codec, dict(options or {})
        self.codec: Codec[Any] = make_codec(self.wire, codec, self._options)
        if isinstance(signal, Source):
            self._source, self._ours = signal, False
        else:
            values = np.asarray(signal, np.float32)
            if values.ndim != 3:
                raise ConfigError(f"a signal is (n, element, channel), not {values.shape}")
            elements, channels = values.shape[1:]
            spec = spec or self.codec.spec or synthetic_spec(elements, channels, 1000.0)
            self._source, self._ours = ArraySource(spec, cut(values, spec.rate_hz)), True
        self.emulator = Emulator(
            self.codec, self._source, self._endpoint(), faults, pace=pace, **emulator
        )

    def _endpoint(self) -> "Endpoint[Any]":
        raise NotImplementedError

    @property
    def port(self) -> str:
        """What a program opens: a serial port's path, or INTERFACE:CHANNEL."""
        return self.emulator.address.partition(":")[2].removeprefix("//")

    @property
    def url(self) -> str:
        """For `open_source`."""
        query = urlencode({"codec": self._name, **self._options})
        return f"{quote(self.emulator.address, safe=':/')}?{query}"

    def unplug(self) -> None:
        """Pull it out."""
        self.emulator.unplug()

    def replug(self, restart: bool = False) -> None:
        """Plug it in again; see `Emulator.replug`."""
        self.emulator.replug(restart)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until all is sent; whether it is."""
        return self.emulator.wait(timeout)

    def close(self) -> None:
        """Leave nothing behind; safe to call twice."""
        self.emulator.close()
        if self._ours:
            self._source.close()

    def __enter__(self) -> Self:
        self.emulator.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class FakeSerial(_FakeDevice):
    """A device on a serial port: a pty, which any program can open. Unix only.

    Args:
        signal: (n, element, channel) SI what it measures, or a source.
        codec: name of what it speaks.
        link: a symbolic link to the port, so that it comes again under the same name when
            replugged; None: /dev/pts/N.
        spec: the array, if neither the codec nor a source tells.
        options: of the codec, as in a URL.
        faults: what goes wrong, see `tactile_rt.drivers.emulation.faults`.
        pace: ``realtime``, or ``fast``: as soon as it is read.
        emulator: further options of `Emulator`.

    Raises:
        ConfigError: unknown codec or option, or a signal of another shape.
    """

    wire = "serial"

    def __init__(
        self,
        signal: ArrayLike | Source,
        codec: str = "native",
        *,
        link: str | None = None,
        **further: Any,
    ) -> None:
        self._link = link
        super().__init__(signal, codec, **further)

    def _endpoint(self) -> "Endpoint[Any]":
        from tactile_rt.drivers.emulation.endpoints import SerialEndpoint

        return SerialEndpoint(self._link)


class FakeCan(_FakeDevice):
    """A device on a CAN bus: behind an slcan adapter on a pty, or on a bus of python-can.

    Args:
        bus: ``INTERFACE:CHANNEL``, e.g. ``virtual:test``; None: slcan.
        fd: whether to open that bus for CAN FD.

    The other arguments are those of `FakeSerial`.
    """

    wire = "can"

    def __init__(
        self,
        signal: ArrayLike | Source,
        codec: str = "native",
        *,
        bus: str | None = None,
        fd: bool = False,
        link: str | None = None,
        **further: Any,
    ) -> None:
        self._bus, self._fd, self._link = bus, fd, link
        super().__init__(signal, codec, **further)

    def _endpoint(self) -> "Endpoint[Any]":
        from tactile_rt.drivers.emulation.endpoints import BusEndpoint, SlcanEndpoint

        return SlcanEndpoint(self._link) if self._bus is None else BusEndpoint(self._bus, self._fd)
