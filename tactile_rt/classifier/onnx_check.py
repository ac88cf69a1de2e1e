"""Safe inspection of ONNX files: a bounded walk over their protobuf fields, without running them.

onnxruntime obeys the file: external data at any path, an operator's context in another file, a
constant's shape of any amount of memory. So a file is walked first, and refused if it holds
anything but weights, ONNX's own operators and metadata within these limits. Only the given bytes
are read. Field numbers are those of ``onnx.proto`` (IR version 10).
"""

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

MAX_BYTES = 2**31 - 1  # protobuf's own limit
MAX_METADATA = 4 * 2**20  # bytes: labels, array, provenance and figures take some 10 kB
MAX_PARTS = 1_000_000  # protobuf fields: the largest network has some 30,000
MAX_DEPTH = 8  # graphs within graphs
MAX_OPSET = 1000  # ONNX is at 26 after nine years
MAX_ELEMENTS = 2**28  # of one tensor: 1 GiB of float32
MAX_SHAPE = 16  # axes of a constant that may be a shape

# onnxruntime's own operators that quantised and fused networks need. No others are allowed:
# EPContext, for example, opens the file that it names.
MICROSOFT = frozenset(
    ("DynamicQuantizeMatMul", "FastGelu", "FusedMatMul", "Gelu", "MatMulIntegerToFloat",
     "MatMulNBits", "QGemm", "QuickGelu", "SkipLayerNormalization")
)  # fmt: skip
# Operators whose output size is the value of a constant input: that input's position.
SIZED_BY = {"ConstantOfShape": 0, "Expand": 1, "OneHot": 1, "Pad": 1, "Range": 1, "Tile": 1}
# Operators whose output shape depends on the values of inputs, not only on their shapes: of all
# inputs, or of those from this position on. Memory and time must not depend on a touch.
SHAPED_BY = {
    **dict.fromkeys(
        ("BlackmanWindow", "ConstantOfShape", "HammingWindow", "HannWindow", "If", "ImageDecoder",
         "MelWeightMatrix", "NonMaxSuppression", "NonZero", "Range", "StringConcat",
         "StringNormalizer", "StringSplit", "Unique"), 0),
    **dict.fromkeys(
        ("AffineGrid", "CenterCropPad", "Col2Im", "Compress", "DFT", "Expand", "OneHot", "Pad",
         "ReduceL1", "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMax", "ReduceMean",
         "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare", "Reshape", "Resize", "STFT",
         "SequenceAt", "SequenceErase", "Slice", "Split", "SplitToSequence", "Squeeze", "Tile",
         "TopK", "Unsqueeze", "Upsample"), 1),
    "MaxUnpool": 2,
    "SequenceInsert": 2,
}  # fmt: skip
VALUE_AT = {"OneHot": 2, "Pad": 2}  # except this input, which only gives a fill value
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
TENSOR_BITS = {1: 32, 2: 8, 3: 8, 4: 16, 5: 16, 6: 32, 7: 64, 9: 8, 10: 16, 11: 64, 12: 32,
               13: 64, 14: 64, 15: 128, 16: 16, 17: 8, 18: 8, 19: 8, 20: 8, 21: 4,
               22: 4}  # fmt: skip
INT64 = 7


class BadModel(Exception):
    """Raised for bytes that are no model safe to open; the message is one line."""


@dataclass
class Contents:
    """The contents of a model file, as read without running it.

    Attributes:
        opset: The version of each operator set, by domain; ``""`` is ONNX's own.
        operators: The number of uses of each operator, by name, subgraphs included.
        inputs, outputs: Names of the graph's inputs and outputs, without the inputs that have a
            stored value.
        weights: The size of all stored tensors, bytes.
    """

    producer: str = ""
    opset: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    operators: Counter[str] = field(default_factory=Counter)
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    weights: int = 0


def read_onnx(data: bytes) -> Contents:
    """Check a serialised ``ModelProto`` and return its contents.

    Raises:
        BadModel: The model is damaged, or has external data, foreign operators, functions,
            training, loops, shapes that depend on values of an input, or exceeds a limit.
    """
    return _Walk(data).model()


def graph_sha256(data: bytes) -> str:
    """Return the SHA-256 (hex) of a model without metadata, which identifies its computation.

    Raises:
        BadModel: The model is damaged.
    """
    digest = hashlib.sha256()
    for number, _, whole in split_fields(data):
        if number != 14:
            digest.update(whole)
    return digest.hexdigest()


def split_fields(data: bytes | memoryview) -> Iterator[tuple[int, memoryview, memoryview]]:
    """Yield (field number, value, whole field) of a protobuf message; numbers have empty values.

    Raises:
        BadModel: The message is damaged.
    """
    walk, at = _Walk(data), 0
    for number, wire, start, end in walk.fields(0, len(data)):
        yield number, walk.data[start:end] if wire == BYTES else walk.data[:0], walk.data[at:end]
        at = end


class _Walk:
    """A parser of a serialised model, with a method that checks each kind of message."""

    def __init__(self, data: bytes | memoryview) -> None:
        if len(data) > MAX_BYTES:
            raise BadModel(f"{len(data)} bytes, more than the {MAX_BYTES} that ONNX allows")
        self.data = memoryview(data)
        self.parts = 0
        self.found = Contents()
        self.sizes: dict[str, int] = {}  # elements that constants ask for, if used as shapes
        self.asked: list[tuple[str, str]] = []  # (operator, constant) to look up at the end
        self.nodes: list[tuple[str, list[str], list[str]]] = []  # operator, inputs, outputs

    def fields(self, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
        """Yield (field number, wire type, start or varint value, end) of each field."""
        while at < end:
            self.parts += 1
            if self.parts > MAX_PARTS:
                raise BadModel(f"more than {MAX_PARTS} parts")
            tag, at = self.varint(at, end)
            number, wire = tag >> 3, tag & 7
            if tag >= 2**32 or number == 0:
                raise BadModel(f"damaged at byte {at}")
            value = at
            if wire == VARINT:
                value, at = self.varint(at, end)
            elif wire == BYTES:
                length, value = self.varint(at, end)
                at = value + length
            elif wire in (FIXED32, FIXED64):
                at += 4 if wire == FIXED32 else 8
            else:
                raise BadModel(f"damaged at byte {at}")
            if at > end:
                raise BadModel(f"cut short or damaged at byte {value}")
            yield number, wire, value, at

    def varint(self, at: int, end: int) -> tuple[int, int]:
        value = 0
        for shift in range(0, 70, 7):
            if at >= end:
                raise BadModel(f"cut short or damaged at byte {at}")
            byte = self.data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value & (2**64 - 1), at
        raise BadModel(f"damaged at byte {at}")

    def messages(self, at: int, end: int, **wanted: int) -> Iterator[tuple[str, int, int]]:
        """Yield (name, start, end) of the named fields, which must hold bytes; skip others."""
        names = {number: name for name, number in wanted.items()}
        for number, wire, start, stop in self.fields(at, end):
            if number in names:
                if wire != BYTES:
                    raise BadModel(f"damaged at byte {start}")
                yield names[number], start, stop

    def text(self, at: int, end: int) -> str:
        try:
            return str(self.data[at:end], "utf-8")
        except UnicodeDecodeError:
            raise BadModel(f"damaged text at byte {at}") from None

    def model(self) -> Contents:
        graphs = described = 0
        parts = self.messages(
            0, len(self.data), producer=2, graph=7, opset=8, metadata=14, training=20, function=25
        )
        for what, at, end in parts:
            if what == "producer":
                self.found.producer = self.text(at, end)
            elif what == "graph":
                graphs += 1
                self.graph(at, end, 0)
            elif what == "opset":
                self.opset(at, end)
            elif what == "metadata":
                described += end - at
                if described > MAX_METADATA:
                    raise BadModel(f"more than {MAX_METADATA} bytes of metadata")
                self.metadata(at, end)
            else:
                raise BadModel(f"it contains an ONNX {what} section, which is not supported")
        if graphs != 1:
            raise BadModel("no graph in it" if not graphs else "more than one graph")
        if len(self.found.opset.keys() & {"", "ai.onnx"}) != 1:
            raise BadModel("it must state exactly one version of ONNX's operators")
        for operator, name in self.asked:
            if self.sizes.get(name, 0) > MAX_ELEMENTS:
                raise BadModel(f"{operator} asks for {self.sizes[name]} elements")
        self.check_shapes()
        return self.found

    def check_shapes(self) -> None:
        """Raise `BadModel` if a shape depends on the values of the graph's inputs.

        No trial run could cover all such shapes. Nodes may be in any order, and names within a
        subgraph count as global."""
        readers: dict[str, list[int]] = {}
        for i, (operator, inputs, _) in enumerate(self.nodes):
            if operator not in ("Shape", "Size"):  # they read shapes, which no touch changes
                for name in set(inputs):
                    readers.setdefault(name, []).append(i)
        live, waiting = set(self.found.inputs), list(self.found.inputs)
        while waiting:
            for i in readers.get(waiting.pop(), ()):
                operator, inputs, outputs = self.nodes[i]
                first, value = SHAPED_BY.get(operator, len(inputs)), VALUE_AT.get(operator)
                if any(n in live for k, n in enumerate(inputs) if k >= first and k != value):
                    raise BadModel(f"operator {operator!r} computes a shape from measured values")
                new = set(outputs) - live
                live |= new
                waiting += new

    def opset(self, at: int, end: int) -> None:
        domain, version = "", 0
        for number, wire, value, stop in self.fields(at, end):
            if (number, wire) == (1, BYTES):
                domain = self.text(value, stop)
            elif (number, wire) == (2, VARINT):
                version = value
        if domain in self.found.opset or not 0 < version <= MAX_OPSET:
            raise BadModel(f"opset {version} of {domain[:40] or 'ai.onnx'!r} is not supported")
        self.found.opset[domain] = version

    def metadata(self, at: int, end: int) -> None:
        pair = {"key": "", "value": ""}
        for what, start, stop in self.messages(at, end, key=1, value=2):
            pair[what] = self.text(start, stop)
        if pair["key"] in self.found.metadata:
            raise BadModel(f"metadata key {pair['key'][:40]!r} appears twice")
        self.found.metadata[pair["key"]] = pair["value"]

    def graph(self, at: int, end: int, depth: int) -> tuple[list[str], list[str]]:
        """Check a graph; return the names of its inputs and outputs."""
        if depth > MAX_DEPTH:
            raise BadModel(f"more than {MAX_DEPTH} graphs within graphs")
        names: dict[str, list[str]] = {"tensor": [], "input": [], "output": [], "value": []}
        parts = self.messages(at, end, node=1, tensor=5, input=11, output=12, value=13, sparse=15)
        for what, start, stop in parts:
            if what == "node":
                self.node(start, stop, depth)
            elif what == "sparse":
                self.sparse(start, stop)
            else:
                read = self.tensor if what == "tensor" else self.value
                names[what].append(read(start, stop))
        if depth == 0:
            stored = set(names["tensor"])
            self.found.inputs = tuple(name for name in names["input"] if name not in stored)
            self.found.outputs = tuple(names["output"])
        return names["input"], names["output"]

    def node(self, at: int, end: int, depth: int) -> None:
        inputs, outputs, operator, domain = [], [], "", ""
        attributes = []
        for what, start, stop in self.messages(
            at, end, input=1, output=2, operator=4, attribute=5, domain=7
        ):
            if what == "attribute":
                attributes.append((start, stop))
                continue
            text = self.text(start, stop)
            if what == "input":
                inputs.append(text)
            elif what == "output":
                outputs.append(text)
            elif what == "operator":
                operator = text
            else:
                domain = text
        if domain not in ("", "ai.onnx") and not (
            domain == "com.microsoft" and operator in MICROSOFT
        ):
            raise BadModel(f"operator {operator[:40]!r} of {domain[:40]!r} is not supported")
        if operator == "Loop":
            raise BadModel("operator 'Loop', which may never end")
        self.found.operators[operator] += 1
        outputs = [name for name in outputs if name]  # omitted outputs have no name
        self.nodes.append((operator, inputs, outputs))
        for start, stop in attributes:
            for inner_inputs, inner_outputs in self.attribute(
                start, stop, depth, outputs[0] if outputs else ""
            ):
                self.nodes.append(("", [*inputs, *inner_outputs], [*inner_inputs, *outputs]))
        position = SIZED_BY.get(operator)
        if position is not None and len(inputs) > position:
            self.asked.append((operator, inputs[position]))

    def attribute(
        self, at: int, end: int, depth: int, output: str
    ) -> list[tuple[list[str], list[str]]]:
        """Check a node's attribute; return inputs and outputs of each graph within it.

        `output` is the name of the tensor if the node is a Constant."""
        graphs = []
        for what, start, stop in self.messages(
            at, end, tensor=5, graph=6, tensors=10, graphs=11, sparse=22, sparses=23
        ):
            if what.startswith("graph"):
                graphs.append(self.graph(start, stop, depth + 1))
            elif what.startswith("sparse"):
                self.sparse(start, stop)
            else:
                self.tensor(start, stop, output)
        return graphs

    def sparse(self, at: int, end: int) -> None:
        for _, start, stop in self.messages(at, end, values=1, indices=2):
            self.tensor(start, stop)

    def tensor(self, at: int, end: int, name: str = "") -> str:
        """Check a tensor; return its name, which is `name` or else the stored name."""
        dims: list[int] = []
        kind, raw, values = 0, None, []
        for number, wire, value, stop in self.fields(at, end):
            if number in (8, 9) and wire != BYTES:
                raise BadModel(f"damaged at byte {stop}")
            if number == 1:
                dims += [value] if wire == VARINT else self.varints(value, stop)
            elif number == 2:
                kind = value
            elif number == 7 and stop - value <= MAX_SHAPE * 10:
                values += [value] if wire == VARINT else self.varints(value, stop)
            elif number == 8 and not name:
                name = self.text(value, stop)
            elif number == 9:
                raw = (value, stop)
            elif number == 13 or (number == 14 and (wire != VARINT or value)):
                raise BadModel(f"tensor {name[:40]!r} is in another file, which is not supported")
        elements = math.prod(dims)  # a negative dimension reads as a huge number
        if elements > MAX_ELEMENTS:
            raise BadModel(f"tensor {name[:40]!r} has {elements} elements, which is too many")
        if raw is None:
            short = elements > 2 * (end - at)  # 4-bit numbers are the smallest
        else:
            bits = TENSOR_BITS.get(kind)
            short = bits is None or (elements * bits + 7) // 8 != raw[1] - raw[0]
        if short:
            raise BadModel(f"tensor {name[:40]!r} does not hold its {elements} elements")
        self.found.weights += end - at
        if kind == INT64 and elements <= MAX_SHAPE:
            if raw is not None:
                values = np.frombuffer(self.data[raw[0] : raw[1]], "<u8").tolist()
            self.sizes[name] = math.prod(abs(v - 2**64 if v >> 63 else v) or 1 for v in values)
        return name

    def varints(self, at: int, end: int) -> list[int]:
        values = []
        while at < end:
            self.parts += 1
            if self.parts > MAX_PARTS:
                raise BadModel(f"more than {MAX_PARTS} parts")
            value, at = self.varint(at, end)
            values.append(value)
        return values

    def value(self, at: int, end: int) -> str:
        """Check the declared size of a graph's input, output or inner value; return its name.

        ValueInfoProto -> TypeProto -> TypeProto.Tensor -> TensorShapeProto -> dimensions.
        """
        elements, name = 1, ""
        for what, a, b in self.messages(at, end, name=1, type=2):
            if what == "name":
                name = self.text(a, b)
                continue
            for _, c, d in self.messages(a, b, tensor=1):
                for _, e, f in self.messages(c, d, shape=2):
                    for _, g, h in self.messages(e, f, dimension=1):
                        sizes = []
                        for number, wire, start, stop in self.fields(g, h):
                            if (number, wire) == (1, VARINT):
                                sizes.append(start)
                            elif (number, wire) == (2, BYTES):
                                self.text(start, stop)  # a symbolic name, which onnxruntime keeps
                        elements *= max(sizes, default=1)
        if elements > MAX_ELEMENTS:
            raise BadModel(f"a value has {elements} elements, which is too many")
        return name
