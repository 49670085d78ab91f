"""Farthest points, ball query and nearest three inside the exported graph, for a batch of one.

Same meaning as the C operators of ``geometry.sampling`` and the same order of operations in float32, so that the graph
chooses the same points and neighbours and the poses of both differ by rounding only. These functions are for export:
outside of a trace the operators answer zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import onnx_ir as ir
import torch
from jaxtyping import Float, Int
from torch import Tensor

from attentionvote.export.graph_ball_query import ball_query
from attentionvote.export.graph_blocks import in_blocks
from attentionvote.export.graph_farthest_points import farthest_points
from attentionvote.export.graph_operators import INT, constant, inner, operator, traced_operator, value
from attentionvote.model.neighborhoods import Layout, Neighborhoods

_SMALL, _LARGE, _MANY = 32, 64, 8192  # points a block, and of how many points on blocks are large: measured


def farthest_point_order(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """Indices of ``count`` points, each the farthest from all before it, from index 0 on; ties to the lowest index."""
    return traced_operator("FarthestPoints", [points], {"count": count}, [[count]])[0]


def shapes_of(layout: Layout) -> list[tuple[int, ...]]:
    """Of the farthest-point order and the four lists of neighbours."""
    return [layout.centers[:1], *zip(layout.centers, layout.neighbors, strict=True)]


def find_neighborhoods(
    points: Float[Tensor, "1 points 3"], layout: Layout, order_and_neighbors: Sequence[Int[Tensor, "*sizes"]]
) -> Neighborhoods:
    """``model.neighborhoods.find_neighborhoods`` of a batch of one, in standard operators.

    Args:
        points: metres.
        layout: the levels.
        order_and_neighbors: taken as they are; computed where they are empty.
    """
    cloud = points[0]
    sizes = {"centers": layout.centers, "neighbors": layout.neighbors, "radii": layout.radii}
    order, *neighbors = traced_operator("Neighborhoods", [cloud, *order_and_neighbors], sizes, shapes_of(layout))
    ordered = cloud[order]
    pairs = ((layout.centers[3], layout.centers[2]), (layout.centers[2], layout.centers[1]))
    interpolation = [three_nearest(ordered[:coarse], ordered[:fine]) for coarse, fine in pairs]
    return Neighborhoods(
        order[None],
        tuple(n[None] for n in neighbors),
        tuple(index[None] for index, _ in interpolation),
        tuple(weight[None] for _, weight in interpolation),
    )


def three_nearest(
    sources: Float[Tensor, "sources 3"], targets: Float[Tensor, "targets 3"]
) -> tuple[Int[Tensor, "targets 3"], Float[Tensor, "targets 3"]]:
    """The three nearest sources of every target and their inverse-distance weights, which sum to one."""
    dx, dy, dz = (t[:, None] - s for t, s in zip(targets.unbind(-1), sources.unbind(-1), strict=True))
    squared, index = torch.topk(dx * dx + dy * dy + dz * dz, 3, dim=1, largest=False, sorted=True)
    # PointNet++'s 1e-10 m^2 in square millimetres: the exporter deletes additions below 1e-8.
    weight = 1.0 / (squared * 1e6 + 1e-4)
    return index, weight / weight.sum(-1, keepdim=True)


@operator("FarthestPoints")
def _farthest_points(op: Any, points: ir.Value, count: int) -> ir.Value:
    planes, number = op.Transpose(points, perm=[1, 0]), _number(points)
    return farthest_points(op, planes, in_blocks(op, planes, number, _block(number)), number, count)


@operator("Neighborhoods")
def _neighborhoods(
    op: Any,
    points: ir.Value,
    *order_and_neighbors: ir.Value,
    centers: list[int],
    neighbors: list[int],
    radii: list[float],
) -> list[ir.Value]:
    shapes = [centers[:1], *([size, count] for size, count in zip(centers, neighbors, strict=True))]

    def spaces(name: str) -> list[ir.Value]:
        return [value(f"{name}_{level}", INT, shape) for level, shape in enumerate(shapes)]

    def take(op: Any) -> list[ir.Value]:
        return [op.Reshape(indices, shape) for indices, shape in zip(order_and_neighbors, shapes, strict=True)]

    def find(op: Any) -> list[ir.Value]:
        return _searched(op, points, centers, neighbors, radii)

    nothing = op.Equal(op.Size(order_and_neighbors[0]), constant(op, 0))
    branches = {
        "then_branch": inner(op, "find", find, [], spaces("found")),
        "else_branch": inner(op, "take", take, [], spaces("taken")),
    }
    return list(op.If(nothing, **branches, _outputs=len(shapes)))


def _searched(
    op: Any, points: ir.Value, centers: list[int], neighbors: list[int], radii: list[float]
) -> list[ir.Value]:
    below, number = op.Transpose(points, perm=[1, 0]), _number(points)
    blocks = in_blocks(op, below, number, max(_block(number), neighbors[0]))
    order = farthest_points(op, below, blocks, number, centers[0])
    ordered = op.Gather(below, order, axis=1)
    levels: list[ir.Value] = []
    for size, count, radius in zip(centers, neighbors, radii, strict=True):
        middle = op.Slice(ordered, [0], [size], [1])
        if levels:
            blocks = in_blocks(op, below, number, max(_block(number), count))
        levels.append(ball_query(op, blocks, middle, size, radius, count))
        below, number = middle, size
    return [order, *levels]


def _number(points: ir.Value) -> int:
    assert points.shape is not None
    number = points.shape[0]
    assert isinstance(number, int)
    return number


def _block(number: int) -> int:
    """Points a block."""
    return _LARGE if number >= _MANY else _SMALL
