"""Farthest-point order in the exported graph: exact, and some dozen points at a time instead of one.

A step of the textbook's loop is ten small operations on all points, and there are as many steps as points to choose.
But a point that is chosen lowers the distances of points near it only. So of the points sorted by falling distance the
next ones are chosen as they stand, unless an earlier one of them lowers them. A round

1. takes the ``CANDIDATES`` farthest points, of equally far ones those with the lowest indices. It leaves out those
   that an earlier one lowers which itself stays. What stays is chosen as far as it is above what the others fall to. No
   point from outside comes in between: it is less far, or as far and of a higher index;
2. brings the distances up to date near the points chosen: in blocks of neighbours that are nearer to one than the
   farthest distance of all was. Most blocks are not.

Of the 20,000 points of a pile 2,048 are chosen in some sixty rounds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx_ir as ir

from attentionvote.export.graph_blocks import Blocks, squared_gap, squared_length
from attentionvote.export.graph_operators import BOOL, FLOAT, INT, constant, inner, value

CANDIDATES = 64
PASSES = 2  # over who lowers whom; chains are seldom longer, and what a longer one leaves open is for the next round


def farthest_points(op: Any, planes: ir.Value, blocks: Blocks, number: int, count: int) -> ir.Value:
    """``(count,)`` indices, each of the point farthest from all before it, from point 0 on; ties to the lowest index.

    Args:
        op: the builder.
        planes: ``(3, number)``.
        blocks: the same points.
        number: of points.
        count: of points to choose.

    Raises:
        ValueError: when there are fewer points than to choose.
    """
    if not 1 <= count <= number:
        raise ValueError(f"count must lie in 1..{number} (the number of points), got {count}")
    first = op.Slice(planes, [0], [1], [1])
    nearest = op.Reshape(squared_length(op, op.Sub(planes, first)), [number])

    def body(op: Any, _: ir.Value, __: ir.Value, nearest: ir.Value, order: ir.Value) -> tuple[ir.Value, ...]:
        added, most = _choose(op, planes, nearest, min(CANDIDATES, number))
        nearest = _lowered(op, planes, blocks, nearest, added, most)
        order = op.Concat(order, added, axis=0)
        progress = op.Greater(op.Shape(added), constant(op, [0]))
        return op.And(progress, op.Less(op.Shape(order), constant(op, [count]))), nearest, order

    step = inner(
        op,
        "round",
        body,
        [
            value("turn", INT, []),
            value("before", BOOL, [1]),
            value("from", FLOAT, [number]),
            value("some", INT, [None]),
        ],
        [value("after", BOOL, [1]), value("to", FLOAT, [number]), value("more", INT, [None])],
    )
    order = op.Loop(None, constant(op, [count > 1]), nearest, constant(op, [0]), body=step, _outputs=2)[1]
    # A round chooses nothing when all distances are 0. Then the lowest index is the farthest for ever.
    return op.Slice(op.Concat(order, constant(op, np.zeros(count, np.int64)), axis=0), [0], [count])


def _choose(op: Any, planes: ir.Value, nearest: ir.Value, size: int) -> tuple[ir.Value, ir.Value]:
    """The indices of the next points, none when all distances are 0; and the largest distance, squared, ``(1,)``."""
    squared, candidate = op.TopK(nearest, [size], largest=1, sorted=1, _outputs=2)
    points = op.Gather(planes, candidate, axis=1)
    table = squared_length(op, op.Sub(op.Unsqueeze(points, [2]), op.Unsqueeze(points, [1])))
    earlier = constant(op, np.triu(np.ones((size, size), bool), 1))
    lowers = op.And(op.Less(table, squared), earlier)  # row: by whom; column: whom
    numbers = op.Cast(lowers, to=FLOAT)
    # Who is lowered by nobody who is lowered by nobody ...: right for the first of them, and further with every pass.
    free = constant(op, np.ones((1, 1, size), np.float32))
    for _ in range(PASSES + 1):
        before, free = free, op.Relu(op.Sub(1.0, op.MatMul(free, numbers)))
    places = constant(op, np.arange(size))
    settled = op.Less(places, op.ReduceMin(op.Where(op.Equal(free, before), size, places), keepdims=0))
    by_free = op.And(lowers, op.Greater(op.Transpose(free, perm=[0, 2, 1]), 0.0))
    fallen = op.ReduceMax(op.Where(by_free, table, 0.0), keepdims=0)
    settled_free = op.Where(op.And(op.Greater(squared, fallen), settled), free, 0.0)
    return op.Gather(candidate, op.Gather(op.NonZero(settled_free), 2, axis=0)), op.Slice(squared, [0], [1])


def _lowered(op: Any, planes: ir.Value, blocks: Blocks, nearest: ir.Value, added: ir.Value, most: ir.Value) -> ir.Value:
    """The squared distances when more points are chosen."""
    points = op.Unsqueeze(op.Gather(planes, added, axis=1), [2])
    pairs = op.NonZero(op.Less(squared_gap(op, blocks, points, points), most))
    point, block = op.Gather(pairs, 1, axis=0), op.Gather(pairs, 2, axis=0)
    squared = squared_length(op, op.Sub(op.Gather(blocks.points, block, axis=1), op.Gather(points, point, axis=1)))
    # Not ScatterND: onnxruntime runs that on several threads, and two points may lower the same third.
    index = op.Reshape(op.Gather(blocks.indices, block, axis=0), [-1])
    return op.ScatterElements(nearest, index, op.Reshape(squared, [-1]), axis=0, reduction="min")
