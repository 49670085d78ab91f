"""Tensors outside the file are seen wherever ONNX allows a tensor, and no bundle with one is loaded."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.bundles.external_data import external_tensor
from attentionvote.inference.errors import BundleError


def outside(name: str = "secret", location: str = "secret.bin") -> TensorProto:
    """Four numbers in another file."""
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value=location)
    return tensor


def sparse(values: TensorProto, indices: TensorProto) -> onnx.SparseTensorProto:
    return onnx.SparseTensorProto(values=values, indices=indices, dims=[9])


def initializer(model: Any) -> None:
    model.graph.initializer.append(outside())


def another_folder(model: Any) -> None:
    model.graph.initializer.append(outside(location="../x/secret.bin"))


def only_marked(model: Any) -> None:
    model.graph.initializer.append(
        TensorProto(name="secret", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    )


def only_named(model: Any) -> None:
    tensor = outside()
    tensor.data_location = TensorProto.DEFAULT
    model.graph.initializer.append(tensor)


def constant(model: Any) -> None:
    model.graph.node.append(helper.make_node("Constant", [], ["unused"], value=outside()))


def tensor_list(model: Any) -> None:
    model.graph.node.append(onnx.NodeProto(op_type="Constant", output=["unused"]))
    model.graph.node[-1].attribute.add(name="values", type=onnx.AttributeProto.TENSORS).tensors.append(outside())


def loop(model: Any) -> None:
    """An initializer of a graph in a Loop in a Loop."""
    inner = helper.make_graph([], "inner", [], [], [outside()])
    outer = helper.make_graph([helper.make_node("Loop", [], [], body=inner)], "outer", [], [])
    model.graph.node.append(helper.make_node("Loop", [], ["unused"], body=outer))


def graph_list(model: Any) -> None:
    attribute = onnx.AttributeProto(name="graphs", type=onnx.AttributeProto.GRAPHS)
    attribute.graphs.append(helper.make_graph([], "inner", [], [], [outside()]))
    model.graph.node.append(onnx.NodeProto(op_type="If", attribute=[attribute]))


def sparse_values(model: Any) -> None:
    inside = numpy_helper.from_array(np.arange(4), "indices")
    model.graph.sparse_initializer.append(sparse(outside(), inside))


def sparse_attribute(model: Any) -> None:
    inside = numpy_helper.from_array(np.arange(4, dtype=np.float32), "values")
    model.graph.node.append(helper.make_node("Constant", [], ["unused"], sparse_value=sparse(inside, outside())))


def sparse_list(model: Any) -> None:
    attribute = onnx.AttributeProto(name="tensors", type=onnx.AttributeProto.SPARSE_TENSORS)
    attribute.sparse_tensors.append(sparse(outside(), TensorProto()))
    model.graph.node.append(onnx.NodeProto(op_type="Constant", attribute=[attribute]))


def function(model: Any) -> None:
    nodes = [helper.make_node("Constant", [], ["y"], value=outside())]
    model.functions.append(helper.make_function("own", "f", [], ["y"], nodes, [helper.make_opsetid("", 20)]))


def function_default(model: Any) -> None:
    model.functions.add(name="f", domain="own").attribute_proto.append(helper.make_attribute("value", outside()))


def training(model: Any) -> None:
    model.training_info.add().algorithm.CopyFrom(helper.make_graph([], "step", [], [], [outside()]))


CHANGES = [
    initializer, another_folder, only_marked, only_named, constant, tensor_list, loop, graph_list, sparse_values,
    sparse_attribute, sparse_list, function, function_default, training,
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_bundle_with_a_tensor_outside_is_refused(
    make_bundle: Callable[..., Path], change: Callable[[Any], None]
) -> None:
    def changed(folder: Path) -> None:
        model = onnx.load(folder / "model.onnx")
        change(model)
        (folder / "model.onnx").write_bytes(model.SerializeToString())

    folder = make_bundle(change=changed)
    sentence = "model.onnx must hold the numbers of all its tensors, but tensor 'secret' names a file outside"
    with pytest.raises(BundleError, match=re.escape(f"{folder}: {sentence}")):
        load_bundle(folder, None)


def test_the_runtime_would_have_read_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the refusal is good for: a relative path is one of the working directory."""
    np.full(4, 7, np.float32).tofile(tmp_path / "secret.bin")
    monkeypatch.chdir(tmp_path)
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [4])
    graph = helper.make_graph([helper.make_node("Identity", ["secret"], ["y"])], "g", [], [output], [outside()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10).SerializeToString()
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    assert session.run(None, {})[0].tolist() == [7, 7, 7, 7]
    assert external_tensor(model) == "secret"


def test_ordinary_graphs_have_none(make_card: Callable[..., Any], make_graph: Callable[..., Any]) -> None:
    assert external_tensor(make_graph(make_card()).SerializeToString()) is None
    with_loop = make_graph(make_card(), loops=5).SerializeToString()
    assert external_tensor(with_loop) is None


def test_a_tag_that_is_written_longer_is_seen() -> None:
    """Readers accept numbers with leading zeros: field 5 as ``aa 00`` instead of ``2a``."""
    tensor = b"\xf0\x00\x81\x00"  # data_location 1
    attribute = b"\xaa\x80\x00" + bytes([len(tensor)]) + tensor
    node = b"\xaa\x00" + bytes([len(attribute)]) + attribute
    graph = b"\x8a\x00" + bytes([len(node)]) + node
    model = b"\xba\x00" + bytes([len(graph)]) + graph
    assert onnx.ModelProto.FromString(model).graph.node[0].attribute[0].t.data_location == TensorProto.EXTERNAL
    assert external_tensor(model) == ""


def test_depth_and_number_of_fields_are_bounded() -> None:
    message = b""
    for _ in range(200):
        for tag in (b"\x32", b"\x2a", b"\x0a"):  # graph of attribute of node of graph
            message = tag + varint(len(message)) + message
    with pytest.raises(ValueError, match="nested more than 100 deep"):
        external_tensor(b"\x3a" + varint(len(message)) + message)
    started = time.process_time()
    with pytest.raises(ValueError, match="more than 1000000 fields"):
        external_tensor(b"\x08\x01" * 4_000_000)
    assert time.process_time() - started < 5


def varint(value: int) -> bytes:
    """A number as protobuf writes it."""
    return bytes([value & 0x7F | 0x80]) + varint(value >> 7) if value > 0x7F else bytes([value])


def test_the_runtimes_own_format_is_refused() -> None:
    with pytest.raises(ValueError, match="onnxruntime's own format"):
        external_tensor(b"\x0a\x05\x00\x00ORTM")


@given(st.binary(max_size=200))
def test_any_bytes_end_in_an_answer_or_a_value_error(content: bytes) -> None:
    with suppress(ValueError):
        external_tensor(content)
