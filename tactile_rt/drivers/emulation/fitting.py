"""One array's samples as another array's, for a device that is not what is simulated."""

from collections.abc import Callable

import numpy as np

from tactile_rt.stream import ArraySpec, Chunk

__all__ = ["fit"]


def fit(source: ArraySpec, device: ArraySpec) -> Callable[[Chunk], Chunk]:
    """Make a source's chunks those of a device's spec.

    The device's elements are the source's first ones, in order; those beyond are invalid. Its
    channels are those of the same name, or, if no name is the same, those in the same place;
    others are 0. Values pass as they are, whatever the unit.
    """
    if source.shape == device.shape and source.channels == device.channels:
        return lambda chunk: chunk
    columns = [source.channels.index(c) if c in source.channels else -1 for c in device.channels]
    if max(columns) < 0:
        columns = [i if i < len(source.channels) else -1 for i in range(len(device.channels))]
    into = [i for i, column in enumerate(columns) if column >= 0]
    taken = [columns[i] for i in into]
    n = min(len(source.elements), len(device.elements))

    def fitted(chunk: Chunk) -> Chunk:
        values = np.zeros((len(chunk), *device.shape), np.float32)
        values[:, :n, into] = chunk.values[:, :n, taken]
        valid = np.zeros(values.shape[:2], np.bool_)
        valid[:, :n] = chunk.valid[:, :n]
        return Chunk(chunk.seq, chunk.t_ns, values, valid)

    return fitted
