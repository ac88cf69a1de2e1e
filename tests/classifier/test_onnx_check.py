"""The bounded reader against the onnx package, hostile files, and damage."""

import hashlib
import os
from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.classifier.onnx_check import BadModel, graph_sha256, read_onnx
from tactile_rt.core.errors import ModelError
from tests.helpers.tiny_model import GRAPH, write_model


def tiny() -> onnx.ModelProto:
    return onnx.parser.parse_model(GRAPH)


def walk(graph):
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                yield from walk(inner)


@pytest.mark.parametrize("which", ["shipped", "tiny", "branches"])
def test_what_is_read_is_what_the_onnx_package_reads(which: str) -> None:
    made = {"shipped": lambda: onnx.load(shipped_model()), "tiny": tiny, "branches": nested}
    proto = made[which]()
    contents = read_onnx(proto.SerializeToString())
    assert contents.producer == proto.producer_name
    assert contents.opset == {o.domain: o.version for o in proto.opset_import}
    assert contents.metadata == {p.key: p.value for p in proto.metadata_props}
    assert contents.operators == Counter(n.op_type for n in walk(proto.graph))
    assert contents.weights >= sum(numpy_helper.to_array(t).nbytes for t in proto.graph.initializer)


def test_the_hash_is_of_all_but_the_metadata() -> None:
    proto = tiny()
    plain = proto.SerializeToString()
    helper.set_model_props(proto, {"a": "b", "c": "d" * 300})
    described = proto.SerializeToString()
    assert graph_sha256(described) == graph_sha256(plain) == hashlib.sha256(plain).hexdigest()
    # Wherever the metadata stands.
    props = onnx.ModelProto(metadata_props=proto.metadata_props).SerializeToString()
    assert graph_sha256(props + plain) == graph_sha256(plain + props) == graph_sha256(plain)
    proto.graph.node[0].op_type = "Add"
    assert graph_sha256(proto.SerializeToString()) != graph_sha256(plain)


# ---- hostile files: each is given our metadata, so that only what is hostile can be refused


def nested(depth: int = 1) -> onnx.ModelProto:
    """The tiny model with an If of so many levels."""
    proto = tiny()
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
    body = helper.make_graph([helper.make_node("Identity", ["zero"], ["out"])], "body", [], [out])
    for _ in range(depth):
        node = helper.make_node("If", ["yes"], ["out"], then_branch=body, else_branch=body)
        body = helper.make_graph([node], "body", [], body.output)
    proto.graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
    proto.graph.node.append(body.node[0])
    return proto


def external(location: str, into=lambda proto, tensor: proto.graph.initializer.append(tensor)):
    def change(proto):
        tensor = TensorProto(name="far", data_type=1, dims=[2], data_location=1)
        for key, value in {"location": location, "offset": "0", "length": "8"}.items():
            tensor.external_data.add(key=key, value=value)
        into(proto, tensor)

    return change


def in_constant(proto, tensor):
    proto.graph.node.append(helper.make_node("Constant", [], ["far"], value=tensor))


def in_branch(proto, tensor):
    branched = nested(3)
    inner = branched.graph.node[-1]
    while inner.attribute[0].g.node[0].op_type == "If":
        inner = inner.attribute[0].g.node[0]
    inner.attribute[0].g.initializer.append(tensor)
    proto.CopyFrom(branched)


def in_sparse(proto, tensor):
    proto.graph.sparse_initializer.add().values.CopyFrom(tensor)


def initialiser(**fields):
    return lambda proto: proto.graph.initializer.append(TensorProto(name="big", **fields))


def operator(name, domain="", inputs=("zero",), **attributes):
    def change(proto):
        node = helper.make_node(name, list(inputs), ["made"], domain=domain, **attributes)
        proto.graph.node.append(node)

    return change


def asks_for(size, how):
    def change(proto):
        shape = numpy_helper.from_array(np.array(size, dtype=np.int64), "size")
        if how == "constant":
            proto.graph.node.append(helper.make_node("Constant", [], ["size"], value=shape))
        else:
            proto.graph.initializer.append(shape)
        operator("ConstantOfShape", inputs=["size"])(proto)

    return change


def absurd_value(proto):
    absurd = helper.make_tensor_value_info("zero", TensorProto.FLOAT, [2**31, 2**31, 2**31])
    proto.graph.value_info.append(absurd)


def function(proto):
    node = helper.make_node("Identity", ["a"], ["b"])
    proto.functions.append(helper.make_function("x", "F", ["a"], ["b"], [node], proto.opset_import))


HOSTILE = {
    "absolute": (external("/etc/passwd"), "'far' is in another file"),
    "memory": (external("*/_ORT_MEM_ADDR_/*"), "'far' is in another file"),
    "constant": (external("/etc/passwd", in_constant), "'far' is in another file"),
    "branch": (external("/etc/passwd", in_branch), "'far' is in another file"),
    "sparse": (external("/etc/passwd", in_sparse), "'far' is in another file"),
    "huge": (initialiser(data_type=1, dims=[2**31, 2**31]), "'big' has 4611686018427387904 elem"),
    "negative": (initialiser(data_type=1, dims=[-1]), "'big' has 18446744073709551615 elements"),
    "raw": (initialiser(data_type=1, dims=[4], raw_data=b"123"), "does not hold its 4 elements"),
    "type": (initialiser(data_type=99, dims=[1], raw_data=b"1234"), "does not hold its 1 elem"),
    "context": (operator("EPContext", "com.microsoft"), "operator 'EPContext' of 'com.microsoft'"),
    "loop": (operator("Loop"), "operator 'Loop', which may never end"),
    "shape": (asks_for([2**20, 2**20], "constant"), "ConstantOfShape asks for 1099511627776 elem"),
    "shape2": (asks_for([2**20, 2**20], "initialiser"), "ConstantOfShape asks for 1099511627776"),
    "value": (absurd_value, "a value has 9903520314283042199192993792 elements"),
    "function": (function, "contains an ONNX function section"),
    "training": (lambda p: p.training_info.add(), "contains an ONNX training section"),
    "deep": (lambda p: p.CopyFrom(nested(12)), "more than 8 graphs within graphs"),
    "metadata": (lambda p: p.metadata_props.add(key="k", value="x" * 5_000_000), "of metadata"),
    "twice": (lambda p: [p.metadata_props.add(key="k") for _ in range(2)], "'k' appears twice"),
}  # fmt: skip


@pytest.mark.parametrize("which", HOSTILE)
def test_a_hostile_file_is_refused_before_onnxruntime_sees_it(
    which: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, said = HOSTILE[which]
    proto = onnx.load(write_model(tmp_path / "m.onnx"), load_external_data=False)
    change(proto)
    path = tmp_path / "m.onnx"
    path.write_bytes(proto.SerializeToString())
    monkeypatch.setattr("onnxruntime.InferenceSession", None)  # would be a TypeError
    with pytest.raises(ModelError, match=f"^{path} is not a readable ONNX model: ") as caught:
        load_model(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def field(number: int, payload: bytes) -> bytes:
    assert len(payload) < 128
    return bytes([number << 3 | 2, len(payload)]) + payload


@pytest.mark.parametrize(
    "data",
    [
        field(7, b"") + field(7, b""),  # two graphs, which protobuf would merge
        b"\x38\x01",  # a graph that is a number
        b"\x3b\x3c",  # a group, which protobuf skips
        b"\x00\x00",  # field 0
        b"\x3a\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",  # length 2**64 - 1
        b"\xff" * 40,
        # data_location 2**32 + 1, EXTERNAL in 32 bits
        field(7, field(5, b"\x70\x81\x80\x80\x80\x10")),
        field(7, field(1, field(4, b"\xff\xfe"))),  # an operator that is not text
    ],
)
def test_what_parsers_read_differently_is_refused(data: bytes) -> None:
    with pytest.raises(BadModel):
        read_onnx(data)


def test_an_axis_whose_name_is_no_text_is_refused() -> None:
    """onnxruntime hands it on as it is, and Python cannot read it."""
    data = tiny().SerializeToString()
    assert data.count(b"\x12\x01B") > 5
    with pytest.raises(BadModel, match="damaged text at byte"):
        read_onnx(data.replace(b"\x12\x01B", b"\x12\x01\xc2", 1))


def test_many_small_parts_end_soon() -> None:
    with pytest.raises(BadModel, match="more than 1000000 parts"):
        read_onnx(b"\x08\x01" * 1_100_000)


MODEL = tiny().SerializeToString()


@given(st.data())
@hypothesis_settings(max_examples=300)
def test_damage_is_never_anything_but_refused(data: st.DataObject) -> None:
    damaged = bytearray(MODEL[: data.draw(st.integers(0, len(MODEL)))])
    for at in data.draw(st.lists(st.integers(0, max(0, len(damaged) - 1)), max_size=6)):
        if damaged:
            damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        read_onnx(bytes(damaged))
    except BadModel as error:
        assert "\n" not in str(error)


def test_a_file_cut_short_is_never_run(tmp_path: Path) -> None:
    whole = write_model(tmp_path / "m.onnx").read_bytes()
    path = tmp_path / "cut.onnx"
    # All but the last field boundaries are inside something; those lack graph or metadata.
    for length in [*range(0, len(whole) - 1, 97), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(ModelError):
            load_model(path)


def test_a_file_too_large_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "large.onnx"
    path.touch()
    os.truncate(path, 2**31)  # sparse: takes no room
    with pytest.raises(ModelError, match="2147483648 bytes is too large"):
        load_model(path)


def test_damage_that_onnxruntime_sees_is_a_model_error_too(tmp_path: Path) -> None:
    whole = write_model(tmp_path / "m.onnx").read_bytes()
    path, rng, refused = tmp_path / "damaged.onnx", np.random.default_rng(0), 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            load_model(path)
        except ModelError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 100
