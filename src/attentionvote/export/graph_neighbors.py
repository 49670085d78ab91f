"""Farthest points, ball query and nearest three as standard ONNX operators: inside the exported graph.

Same meaning as the C operators of ``geometry.sampling``, and for the farthest points the same order of operations in
float32, so that the graph chooses the same points and neighbours and the poses of both differ by rounding only.
Written for the exporter: loops are ``scan`` (an ONNX Scan), shapes are static, the batch is one.

Formulations (measured in this project's speed notes and again in ``tests/export``): the running minimum of the
farthest-point pass is searched in two steps, rows first, since ArgMax over one long row is slow. "The first k in index
order" is TopK over numbers of which every point inside is an equal 0 and every other one a 1; the ONNX specification
breaks ties by the lower index. ``relu(d^2 - r^2)`` says the same in twice the time, because TopK then meets something
smaller than what it keeps again and again; TopK in two steps, over blocks and over the points of those chosen, gains
nothing. ``torch.topk`` does not promise an order of ties: these functions are for export, not for eager use.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch._higher_order_ops.scan import scan

from attentionvote.model import Layout, Neighborhoods

_ROW = 256  # points a row of the two-step ArgMax
ERROR = 2e-6  # of the matrix product, relative to the squared distances it is made of; float32 has 6e-8 an operation
SPARE = 8  # candidates beyond those wanted: more than ever lie on the edge of a ball
STEEP = 2.0**60  # outside a ball everything is 1: TopK keeps what it has when nothing smaller comes, most of the time
CHUNK = 16  # centres a step: their distances stay in the cache


def farthest_point_order(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """Indices of ``count`` points, each the farthest from all before it, from index 0 on; ties to the lowest index."""
    total = len(points)
    rows = -(-total // _ROW)
    padding = rows * _ROW - total
    x, y, z = (torch.nn.functional.pad(a, (0, padding)) for a in _planes(points))
    # Padding never wins: its distance stays below every real one.
    nearest = torch.cat([torch.full((total,), torch.inf), torch.full((padding,), -1.0)])

    def step(carry: tuple[Tensor, Tensor], _: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        closest, last = carry
        dx, dy, dz = (a - a.index_select(0, last) for a in (x, y, z))
        closest = torch.minimum(closest, dx * dx + dy * dy + dz * dz)
        table = closest.view(rows, _ROW)
        row = table.amax(1).argmax(0, keepdim=True)
        column = table.index_select(0, row).argmax(1)
        return (closest, row * _ROW + column), last.clone()

    start = torch.zeros(1, dtype=torch.int64)
    _, order = scan(step, (nearest, start), torch.zeros(count, 1))
    return order.view(count)


def ball_query(
    points: Float[Tensor, "points 3"], centers: Float[Tensor, "centers 3"], radius: float, count: int
) -> Int[Tensor, "centers count"]:
    """The first ``count`` points in index order within ``radius`` of each centre, short balls padded with their first.

    Every centre is one of the points, so no ball is empty. One matrix product gives ``d^2 - r^2`` of a few centres and
    all points, in half the time of differences and squares but with an error of a millionth of their squared distances
    from the cloud's middle. So it chooses ``SPARE`` candidates too many from a ball larger by that, pair by pair, and
    differences and squares decide among these.
    """
    chunk = _divisor(len(centers))
    most, candidates = min(count, len(points)), min(count + SPARE, len(points))
    middle = points.mean(0)
    p, c = points - middle, centers - middle
    far = _a_little_less(p.square().sum(-1))
    columns = torch.stack([*p.unbind(-1), torch.ones(len(points)), far - radius * radius]) * STEEP
    rows = torch.cat([-2 * c, _a_little_less(c.square().sum(-1, keepdim=True)), torch.ones(len(centers), 1)], dim=-1)
    limit = torch.tensor(radius, dtype=torch.float32).square()

    def step(carry: Tensor, block: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        row, center = block
        near = torch.topk((row @ columns).clamp(0, 1), candidates, dim=1, largest=False, sorted=True)[1]
        dx, dy, dz = (points[near] - center[:, None]).unbind(-1)
        beyond = torch.relu(dx * dx + dy * dy + dz * dz - limit)
        value, place = torch.topk(beyond, most, dim=1, largest=False, sorted=True)
        index = torch.gather(near, 1, place)
        return carry.clone(), torch.where(value > 0, index[:, :1], index)

    _, index = scan(step, torch.zeros(1), (rows.view(-1, chunk, 5), centers.view(-1, chunk, 3)))
    return index.view(len(centers), -1)


def three_nearest(
    sources: Float[Tensor, "sources 3"], targets: Float[Tensor, "targets 3"]
) -> tuple[Int[Tensor, "targets 3"], Float[Tensor, "targets 3"]]:
    """The three nearest sources of every target and their inverse-distance weights, which sum to one."""
    dx, dy, dz = (t[:, None] - s for t, s in zip(targets.unbind(-1), sources.unbind(-1), strict=True))
    squared, index = torch.topk(dx * dx + dy * dy + dz * dz, 3, dim=1, largest=False, sorted=True)
    # PointNet++'s 1e-10 m^2 in square millimetres: the exporter deletes additions below 1e-8.
    weight = 1.0 / (squared * 1e6 + 1e-4)
    return index, weight / weight.sum(-1, keepdim=True)


def find_neighborhoods(points: Float[Tensor, "1 points 3"], layout: Layout) -> Neighborhoods:
    """``model.neighborhoods.find_neighborhoods`` of a batch of one, in standard operators."""
    cloud = points[0]
    order = farthest_point_order(cloud, layout.centers[0])
    ordered = cloud[order]
    below, neighbors = cloud, []
    for size, count, radius in zip(layout.centers, layout.neighbors, layout.radii, strict=True):
        neighbors.append(ball_query(below, ordered[:size], radius, count))
        below = ordered[:size]
    pairs = ((layout.centers[3], layout.centers[2]), (layout.centers[2], layout.centers[1]))
    found = [three_nearest(ordered[:coarse], ordered[:fine]) for coarse, fine in pairs]
    return Neighborhoods(
        order[None],
        tuple(n[None] for n in neighbors),
        tuple(index[None] for index, _ in found),
        tuple(weight[None] for _, weight in found),
    )


def _a_little_less(squared: Tensor) -> Tensor:
    """Less by the error of the matrix product; the exporter deletes a multiplication by 1 - 2e-6."""
    return squared - squared * ERROR


def _planes(points: Tensor) -> list[Tensor]:
    """The three coordinates as tensors of their own: what a scan closes over must not share memory."""
    return [a.clone() for a in points.unbind(-1)]


def _divisor(count: int) -> int:
    """The largest number of centres a step that divides ``count``."""
    return next(n for n in range(min(CHUNK, count), 0, -1) if count % n == 0)
