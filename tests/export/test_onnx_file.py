"""The file: its card inside, and what no exported file may be."""

from __future__ import annotations

from dataclasses import replace

import onnx
import pytest
from onnx import TensorProto, helper

from attentionvote.contract import CARD_KEY, LAYOUT_KEY, ModelCard, TensorSpec
from attentionvote.export.onnx_file import OPSET, check_graph


@pytest.mark.slow
def test_the_graph_carries_its_card_without_what_is_measured_on_it(graph: bytes, card: ModelCard) -> None:
    model = onnx.load_from_string(graph)
    assert [p.key for p in model.metadata_props] == [CARD_KEY, LAYOUT_KEY]
    inside = ModelCard.from_json(model.metadata_props[0].value)
    assert inside == card.core()
    assert inside.evaluation == {}
    check_graph(model, card)
    with pytest.raises(ValueError, match=r"must have the outputs .*'vote_xyz', shape=\(1, 31, 3\).*\(1, 32, 3\)"):
        check_graph(model, replace(card, votes=31))


def trivial(card: ModelCard, domain: str = "", opset: int = OPSET, kind: int = TensorProto.FLOAT) -> onnx.ModelProto:
    """A graph with the card's tensors that answers zeros, through an identity of ``domain``."""

    def value(spec: TensorSpec, type_: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(spec.name, type_, spec.shape)

    nodes = []
    for spec in card.outputs:
        size = 1
        for n in spec.shape:
            size *= n
        zeros = helper.make_tensor(f"{spec.name}_zeros", TensorProto.FLOAT, spec.shape, [0.0] * size)
        nodes.append(helper.make_node("Constant", [], [f"{spec.name}_constant"], value=zeros))
        nodes.append(helper.make_node("Identity", [f"{spec.name}_constant"], [spec.name], domain=domain))
    body = helper.make_graph(nodes, "trivial", [value(s, kind) for s in card.inputs], [value(s) for s in card.outputs])
    opsets = [helper.make_opsetid("", opset)] + ([helper.make_opsetid(domain, 1)] if domain else [])
    return helper.make_model(body, opset_imports=opsets, ir_version=10)


def test_a_graph_of_the_contract_passes(card: ModelCard) -> None:
    check_graph(trivial(card), card)


def test_other_opsets_operators_and_types_are_refused(card: ModelCard) -> None:
    with pytest.raises(ValueError, match="the exported graph must have opset 20, got 21"):
        check_graph(trivial(card, opset=21), card)
    with pytest.raises(ValueError, match=r"must consist of standard operators, got com\.nobody"):
        check_graph(trivial(card, domain="com.nobody"), card)
    with pytest.raises(ValueError, match="the exported graph's points must be float32"):
        check_graph(trivial(card, kind=TensorProto.DOUBLE), card)
