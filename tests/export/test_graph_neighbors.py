"""The in-graph sampling and neighbour search in onnxruntime beside the C operators, whose indices they must give."""

from __future__ import annotations

import io

import numpy as np
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from attentionvote.contract import FOUND
from attentionvote.export import graph_neighbors
from attentionvote.export.graph_operators import OPSET, make_optional, write_out
from attentionvote.export.onnx_file import quiet_exporter
from attentionvote.model.neighborhoods import Layout, find_neighborhoods

COUNT = 600
LAYOUT = Layout((64, 32, 16, 8), (16, 8, 8, 4), (0.02, 0.04, 0.06, 0.12))
pytestmark = pytest.mark.slow


class Finder(nn.Module):
    def forward(self, points: Tensor, *given: Tensor) -> tuple[Tensor, ...]:
        found = graph_neighbors.find_neighborhoods(points, LAYOUT, given)
        return (found.order, *found.neighbors, *found.nearest, *found.weights)


@pytest.fixture(scope="module")
def finder() -> onnxruntime.InferenceSession:
    with quiet_exporter(), torch.no_grad():
        given = (torch.zeros(shape, dtype=torch.int64) for shape in graph_neighbors.shapes_of(LAYOUT))
        names = ["points", *FOUND]
        program = torch.onnx.export(Finder(), (torch.rand(1, COUNT, 3), *given), input_names=names, opset_version=OPSET)
    assert program is not None
    write_out(program.model)
    make_optional(program.model, FOUND)
    buffer = io.BytesIO()
    program.save(buffer)
    return onnxruntime.InferenceSession(buffer.getvalue(), providers=["CPUExecutionProvider"])


def cloud(kind: str) -> NDArray[np.float32]:
    rng = np.random.default_rng(7)
    points = rng.uniform(-0.1, 0.1, (COUNT, 3)) + np.array([0.0, 0.0, 0.8])
    if kind == "lattice":  # many equal distances; exact in float32
        points = rng.integers(-26, 26, (COUNT, 3)) * 2.0**-8 + [0, 0, 0.75]
    elif kind == "repeated":  # a poor cloud is filled up with repetitions
        points = points[rng.integers(0, 40, COUNT)]
    elif kind == "sparse":  # balls that hold their centre only
        points = points * [10, 10, 1]
    elif kind == "stray":  # a few points on a wall ten metres behind
        points[::97] += [3.0, -2.0, 10.0]
    elif kind == "edges":  # half of the points lie on the edge of another one's ball, but for rounding
        direction = rng.normal(size=(COUNT // 2, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points[COUNT // 2 :] = points[: COUNT // 2].astype(np.float32) + LAYOUT.radii[0] * direction
    elif kind == "one place":
        points = np.full((COUNT, 3), 0.5)
    return points.astype(np.float32)


@pytest.mark.parametrize("kind", ["uniform", "lattice", "repeated", "sparse", "stray", "edges", "one place"])
def test_the_graph_finds_what_the_operators_find(finder: onnxruntime.InferenceSession, kind: str) -> None:
    points = cloud(kind)
    order, *rest = (a[0] for a in finder.run(None, {"points": points[None]}))
    expected = find_neighborhoods(points, LAYOUT)
    np.testing.assert_array_equal(order, expected.order)
    for actual, neighbors in zip(rest[:4], expected.neighbors, strict=True):
        np.testing.assert_array_equal(actual, neighbors)
    for actual, nearest in zip(rest[4:6], expected.nearest, strict=True):
        np.testing.assert_array_equal(actual, nearest)
    for actual, weights in zip(rest[6:], expected.weights, strict=True):
        np.testing.assert_allclose(actual, weights, atol=2e-6)


def test_far_from_the_origin_a_ball_keeps_its_points_but_for_rounding(finder: onnxruntime.InferenceSession) -> None:
    """Two metres away float32 has steps of 0.1 micrometres: points so near the edge of a ball may change sides."""
    points = cloud("uniform") + np.float32([1.0, -1.0, 2.0])
    _, first, *_ = (a[0] for a in finder.run(None, {"points": points[None]}))
    expected = find_neighborhoods(points, LAYOUT).neighbors[0].numpy()
    centers = points[find_neighborhoods(points, LAYOUT).order].astype(np.float64)
    distance = np.linalg.norm(points[first].astype(np.float64) - centers[:, None], axis=-1)
    assert distance.max() < LAYOUT.radii[0] * (1 + 1e-4)
    assert (first == expected).all(axis=1).mean() > 0.95
