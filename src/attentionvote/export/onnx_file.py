"""A network as one self-contained ONNX file: standard operators, pinned opset, static shapes, reproducible bytes."""

from __future__ import annotations

import gc
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np
import onnx
import torch

from attentionvote.contract import CARD_KEY, FOUND, INPUTS, LAYOUT_KEY, ModelCard, TensorSpec
from attentionvote.export.graph_neighbors import shapes_of
from attentionvote.export.graph_network import ExportNetwork
from attentionvote.export.graph_operators import OPSET, make_optional, write_out
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Predictions


def export_graph(model: AttentionVote, card: ModelCard) -> bytes:
    """The network with sampling, neighbours, peaks and merging inside, as the bytes of an ONNX file.

    The same weights and card give the same bytes from any checkout: the exporter's notes on source lines are removed.
    The card goes along in ``metadata_props`` under ``CARD_KEY``, without what is measured on the graph.

    Args:
        model: the trained network.
        card: its card; decides N and is checked against the graph.

    Raises:
        ValueError: when the graph does not come out as the card and the contract say.
    """
    example = (*_example(card.points), *(torch.zeros(shape, dtype=torch.int64) for shape in shapes_of(model.layout)))
    with quiet_exporter(), uncollected(), torch.no_grad():
        # Not strict: that refuses calls of operators by name.
        traced = torch.export.export(ExportNetwork(model).eval(), example, strict=False)
        program = torch.onnx.export(
            traced,
            dynamo=True,
            opset_version=OPSET,
            input_names=[*INPUTS, *FOUND],
            output_names=list(Predictions._fields),
            verbose=False,
        )
    assert program is not None
    write_out(program.model)
    make_optional(program.model, FOUND)
    graph = program.model_proto
    _strip(graph.graph)
    del graph.metadata_props[:]
    graph.metadata_props.add(key=CARD_KEY, value=card.core().to_json())
    graph.metadata_props.add(key=LAYOUT_KEY, value=json.dumps(asdict(model.layout)))
    check_graph(graph, card)
    return graph.SerializeToString(deterministic=True)


def check_graph(graph: onnx.ModelProto, card: ModelCard) -> None:
    """Whether a graph keeps the contract.

    Raises:
        ValueError: on another opset, an operator that is not standard, or tensors that differ from the card's.
    """
    onnx.checker.check_model(graph, full_check=True)
    opsets = {entry.domain: entry.version for entry in graph.opset_import}
    if opsets.get("") != OPSET:
        raise ValueError(f"the exported graph must have opset {OPSET}, got {opsets.get('')}")
    foreign = sorted({node.domain for node in _nodes(graph.graph)} - {""}) + [f.name for f in graph.functions]
    if foreign:
        raise ValueError(f"the exported graph must consist of standard operators, got {', '.join(foreign)}")
    optional = {initializer.name for initializer in graph.graph.initializer}
    for kind, expected, actual in (
        ("inputs", card.inputs, [value for value in graph.graph.input if value.name not in optional]),
        ("outputs", card.outputs, graph.graph.output),
    ):
        exported = tuple(_spec(value) for value in actual)
        if exported != expected:
            raise ValueError(f"the exported graph must have the {kind} {expected}, got {exported}")


@contextmanager
def uncollected() -> Iterator[None]:
    """No garbage collection: a trace makes millions of objects that live to its end, an eighth of its time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def quiet_exporter() -> Iterator[None]:
    """Keep the exporter's notes about itself from a user's terminal."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _example(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A cloud to trace with; only its shape matters."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, -0.1, 0.7], [0.1, 0.1, 0.8], (1, count, 3)).astype(np.float32)
    normals = np.broadcast_to(np.array([0, 0, -1], dtype=np.float32), points.shape).copy()
    return torch.from_numpy(points), torch.from_numpy(normals)


def _strip(graph: onnx.GraphProto) -> None:
    """Remove notes that hold paths and source lines of this machine."""
    del graph.metadata_props[:]
    graph.doc_string = ""
    for value in [*graph.input, *graph.output, *graph.value_info, *graph.initializer]:
        value.doc_string = ""
        del value.metadata_props[:]
    for node in _nodes(graph):
        del node.metadata_props[:]
        node.doc_string = ""
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                _strip(attribute.g)


def _nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """Every node, those of inner graphs too."""
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                yield from _nodes(attribute.g)


def _spec(value: onnx.ValueInfoProto) -> TensorSpec:
    tensor = value.type.tensor_type
    if tensor.elem_type != onnx.TensorProto.FLOAT:
        raise ValueError(f"the exported graph's {value.name} must be float32")
    return TensorSpec(value.name, tuple(d.dim_value for d in tensor.shape.dim))
