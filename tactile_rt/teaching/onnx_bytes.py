"""ONNX files written byte by byte, since robots do not have the package `onnx`.

It covers only what a graph of a few operators needs of ``onnx.proto`` (IR version 10). Numbers are
protocol buffers' varints; a message within a message is its length and then its bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tactile_rt.classifier.onnx_check import split_fields

IR_VERSION, OPSET = 10, 20
PRODUCER = "tactile_rt"
FLOAT, INT, STRING, INTS = 1, 2, 3, 7  # kinds of attributes
TYPES = {"float32": 1, "int64": 7, "bool": 9}  # of tensors


def _pack_varint(number: int) -> bytes:
    out = bytearray()
    number &= 2**64 - 1  # a negative number as two's complement of 64 bits
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _pack_int(field_number: int, value: int) -> bytes:
    return _pack_varint(field_number << 3) + _pack_varint(value)


def _pack(field_number: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _pack_varint(field_number << 3 | 2) + _pack_varint(len(data)) + data


def _pack_tensor(name: str, array: NDArray[Any]) -> bytes:
    shape = b"".join(_pack_int(1, size) for size in array.shape)
    data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
    return shape + _pack_int(2, TYPES[array.dtype.name]) + _pack(8, name) + _pack(9, data)


def _pack_value(name: str, shape: Sequence[int | str], dtype: DTypeLike) -> bytes:
    sizes = (_pack_int(1, size) if isinstance(size, int) else _pack(2, size) for size in shape)
    dimensions = b"".join(_pack(1, size) for size in sizes)
    tensor = _pack_int(1, TYPES[np.dtype(dtype).name]) + _pack(2, dimensions)
    return _pack(1, name) + _pack(2, _pack(1, tensor))


def _pack_attribute(name: str, value: int | float | str | Sequence[int]) -> bytes:
    if isinstance(value, str):
        data = _pack(4, value) + _pack_int(20, STRING)
    elif isinstance(value, int):
        data = _pack_int(3, value) + _pack_int(20, INT)
    elif isinstance(value, float):
        data = _pack_varint(2 << 3 | 5) + np.float32(value).tobytes() + _pack_int(20, FLOAT)
    else:
        data = b"".join(_pack_int(8, one) for one in value) + _pack_int(20, INTS)
    return _pack(1, name) + data


def _read_key(value: memoryview) -> str:
    return next(str(text, "utf-8") for number, text, _ in split_fields(value) if number == 1)


def with_metadata(data: bytes, key: str, text: str) -> bytes:
    """Return a model file's bytes with one metadata entry replaced, all else unchanged."""
    kept = (
        bytes(whole)
        for number, value, whole in split_fields(data)
        if number != 14 or _read_key(value) != key
    )
    return b"".join((*kept, _pack(14, _pack(1, key) + _pack(2, text))))


@dataclass
class OnnxGraph:
    """A builder of an ONNX graph, operator by operator, in the order of execution."""

    parts: list[bytes] = field(default_factory=list)
    _names: int = 0

    def constant(self, values: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        """Add a constant tensor to the graph; return its name."""
        name = self._make_name("constant")
        self.parts.append(_pack(5, _pack_tensor(name, np.asarray(values, dtype))))
        return name

    def integers(self, *values: int) -> str:
        """Add a constant list of integers, such as an operator's axes; return its name."""
        return self.constant(values, np.int64)

    def input(self, name: str, shape: Sequence[int | str]) -> str:
        """Declare an input of the graph; return its name. A size given as text is variable."""
        self.parts.append(_pack(11, _pack_value(name, shape, np.float32)))
        return name

    def output(self, name: str, value: str, shape: Sequence[int | str]) -> None:
        """Declare the value named `value` as the graph's output `name`."""
        self._add_node("Identity", [value], [name], {})
        self.parts.append(_pack(12, _pack_value(name, shape, np.float32)))

    def __call__(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add an ONNX operator with one output to the graph; return the output's name."""
        name = self._make_name(operator)
        self._add_node(operator, inputs, [name], attributes)
        return name

    def serialise(self, name: str, metadata: Mapping[str, str]) -> bytes:
        """Return the bytes of an ONNX file with this graph and metadata."""
        graph = b"".join(self.parts) + _pack(2, name)
        pairs = (_pack(14, _pack(1, key) + _pack(2, text)) for key, text in metadata.items())
        opset = _pack(8, _pack(1, "") + _pack_int(2, OPSET))
        head = (_pack_int(1, IR_VERSION), _pack(2, PRODUCER), _pack(7, graph), opset)
        return b"".join((*head, *pairs))

    def _add_node(
        self, operator: str, inputs: Sequence[str], outputs: Sequence[str], attributes: Any
    ) -> None:
        values = [_pack(1, name) for name in inputs] + [_pack(2, name) for name in outputs]
        more = (_pack(5, _pack_attribute(*pair)) for pair in attributes.items())
        self.parts.append(_pack(1, b"".join((*values, _pack(4, operator), *more))))

    def _make_name(self, what: str) -> str:
        self._names += 1
        return f"taught_{what.lower()}_{self._names}"
