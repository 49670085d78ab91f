"""The exported graph in onnxruntime beside the network it was made of."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.export.graph_network import ExportNetwork
from attentionvote.inference.preparation import find_neighbors
from attentionvote.inference.runtime import Session
from attentionvote.model.layers import RowNorm
from attentionvote.model.neighborhoods import Layout
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Predictions

Cloud = tuple[NDArray[np.float32], NDArray[np.float32]]


def test_the_given_network_is_not_changed_and_shares_its_weights(network: AttentionVote) -> None:
    before = {name: value.clone() for name, value in network.state_dict().items()}
    kinds = [type(module) for module in network.modules()]
    twin = ExportNetwork(network).model
    assert [type(module) for module in network.modules()] == kinds
    after = network.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    shared = {p.data_ptr() for p in network.parameters()} & {p.data_ptr() for p in twin.parameters()}
    assert {w.data_ptr() for layer in network.backbone.abstractions for w in layer.weights} <= shared


@pytest.mark.slow
def test_no_norm_is_left(network: AttentionVote, graph: bytes) -> None:
    assert not any(isinstance(module, RowNorm) for module in ExportNetwork(network).modules())
    assert not any(node.op_type == "BatchNormalization" for node in onnx.load(io.BytesIO(graph)).graph.node)


@pytest.fixture(scope="module")
def session(graph: bytes, card: ModelCard) -> Session:
    return Session(graph, card)


def answers(network: AttentionVote, session: Session, cloud: Cloud) -> tuple[Predictions, dict[str, NDArray]]:
    points, normals = (a[None] for a in cloud)
    with torch.no_grad():
        return network(torch.from_numpy(points), torch.from_numpy(normals)), session.run(points, normals)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_every_output_is_the_networks(
    network: AttentionVote, session: Session, make_cloud: Callable[..., Cloud], seed: int
) -> None:
    expected, actual = answers(network, session, make_cloud(seed))
    assert (expected.peak_heat > 0).sum() >= 2
    assert len(set(np.round(expected.confidence[0].numpy(), 4))) > 2
    for name, value in expected._asdict().items():
        np.testing.assert_allclose(actual[name], value.numpy(), atol=3e-5, err_msg=name)


@pytest.mark.slow
def test_neighbours_that_are_given_are_those_that_are_found(
    network: AttentionVote, session: Session, make_cloud: Callable[..., Cloud]
) -> None:
    assert session.layout is not None
    assert Layout(**{name: tuple(sizes) for name, sizes in session.layout.items()}) == network.layout
    points, normals = (a[None] for a in make_cloud(1))
    given = find_neighbors(points, session.layout)
    assert len(given) == 5
    inside, outside = session.run(points, normals), session.run(points, normals, neighbors=given)
    for name, value in inside.items():
        np.testing.assert_array_equal(outside[name], value)
    given[1] = given[1][::-1]
    assert not np.array_equal(session.run(points, normals, neighbors=given)["vote_xyz"], inside["vote_xyz"])


@pytest.mark.slow
@pytest.mark.parametrize("distinct", [1, 3, 20])
def test_poor_clouds_are_answered_alike_and_finitely(
    network: AttentionVote, session: Session, make_cloud: Callable[..., Cloud], distinct: int
) -> None:
    """A sample with repetitions: distances of zero everywhere, boxes without points."""
    points, normals = make_cloud(3)
    chosen = np.random.default_rng(0).integers(0, distinct, len(points))
    expected, actual = answers(network, session, (points[chosen], normals[chosen]))
    for name, value in expected._asdict().items():
        assert np.isfinite(actual[name]).all(), name
        np.testing.assert_allclose(actual[name], value.numpy(), atol=3e-5, err_msg=name)


@pytest.mark.slow
def test_the_graph_has_no_loose_ends(graph: bytes) -> None:
    """Weights lie inside, and nothing points at this machine."""
    model = onnx.load(io.BytesIO(graph))
    assert not any(t.data_location == onnx.TensorProto.EXTERNAL for t in model.graph.initializer)
    assert {n.op_type for n in model.graph.node} >= {"If", "Scan", "TopK", "Gemm"}
    assert b".py" not in graph
    assert b"site-packages" not in graph
