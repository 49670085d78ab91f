"""Operators of this project in the exported graph: traced as one call each, then written out in standard operators.

torch's exporter knows neither loops whose tensors change their size nor updates that keep the smaller value, and both
are what makes these operators fast. So the traced network calls them by name (``traced_operator``), and ``write_out``
puts what ``operator`` registered under that name in the place of every call. What is registered is written with
onnxscript's builder: ``op.Sub(a, b)`` adds a node to the graph and answers its output.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx_ir as ir
import torch
from numpy.typing import ArrayLike
from onnx_ir.passes.common import InlinePass
from onnxscript import build_function, build_graph
from torch import Tensor

OPSET = 20
_DOMAIN = "attentionvote"
_OPSETS = {"": OPSET}
_BODIES: dict[str, Callable[..., Any]] = {}

FLOAT, INT, BOOL = ir.DataType.FLOAT, ir.DataType.INT64, ir.DataType.BOOL


def operator(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Registers a function of the builder, the inputs and the attributes that returns the operator's outputs."""

    def register(body: Callable[..., Any]) -> Callable[..., Any]:
        _BODIES[name] = body
        return body

    return register


def traced_operator(
    name: str, inputs: Sequence[Tensor], attributes: Mapping[str, Any], shapes: Sequence[Sequence[int]]
) -> Sequence[Tensor]:
    """A call that ``write_out`` replaces; its outputs are indices. Outside of a trace it answers zeros.

    Args:
        name: under which the operator is registered.
        inputs: tensors of static shape.
        attributes: numbers and lists of numbers.
        shapes: of the outputs.
    """
    answer: Sequence[Tensor] = torch.onnx.ops.symbolic_multi_out(
        f"{_DOMAIN}::{name}",
        inputs,
        dict(attributes),
        dtypes=[torch.int64] * len(shapes),
        shapes=shapes,
        version=1,
    )
    return answer


def write_out(model: ir.Model) -> None:
    """Put the operators' own nodes in the place of every call in a model."""
    opsets = {**_OPSETS, _DOMAIN: 1}
    for number, node in enumerate(n for n in model.graph if n.domain == _DOMAIN):
        attributes = {name: attribute.value for name, attribute in node.attributes.items()}
        inputs = [ir.Value(name=f"input_{i}", type=v.type, shape=v.shape) for i, v in enumerate(node.inputs) if v]
        body, name = _BODIES[node.op_type], f"{node.op_type}_{number}"

        def traced(op: Any, *values: ir.Value, body: Any = body, attributes: Any = attributes, name: str = name) -> Any:
            op.builder.push_module(name)
            return body(op, *values, **attributes)

        function = build_function(traced, inputs, domain=_DOMAIN, name=name, opset_imports=opsets)
        model.functions[function.identifier()] = function
        node.op_type = name
    InlinePass()(model)
    model.opset_imports.pop(_DOMAIN, None)


def make_optional(model: ir.Model, names: Sequence[str]) -> None:
    """Give inputs a default that is empty along their first dimension: a run may leave them out."""
    for graph_input in model.graph.inputs:
        if graph_input.name in names:
            assert graph_input.shape is not None
            rest = [length for length in graph_input.shape[1:] if isinstance(length, int)]
            graph_input.shape = ir.Shape([f"{graph_input.name}_length", *rest])
            graph_input.const_value = ir.tensor(np.zeros([0, *rest], np.int64), name=graph_input.name)
            model.graph.register_initializer(graph_input)


def constant(op: Any, values: ArrayLike) -> ir.Value:
    """A tensor that is known now."""
    value: ir.Value = op.Constant(value=ir.tensor(np.asarray(values)))
    return value


def value(name: str, kind: ir.DataType, shape: Sequence[int | None]) -> ir.Value:
    """An input or output of an inner graph; None: a length that changes."""
    return ir.Value(name=name, type=ir.TensorType(kind), shape=ir.Shape(shape))


def inner(
    op: Any, name: str, body: Callable[..., Any], inputs: Sequence[ir.Value], outputs: Sequence[ir.Value]
) -> ir.Graph:
    """The graph of a loop's step or a branch; ``body`` may use every value around it.

    Args:
        op: the builder around it.
        name: of the graph, and of its nodes: names of inner graphs must differ from those around them.
        body: function of the inner builder and the inputs.
        inputs, outputs: made with ``value``.
    """

    def traced(op: Any, *values: ir.Value) -> Any:
        op.builder.push_module(name)
        return body(op, *values)

    return build_graph(traced, inputs, outputs, opset_imports=_OPSETS, parent=op.builder, name=name)
