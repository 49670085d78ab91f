"""Farthest-point order in the exported graph: exact, and some dozen points at a time instead of one.

A step of the textbook's loop is ten small operations on all points, and there are as many steps as points to choose. But
choosing a point lowers the distances of others only, and only near it. So of the points sorted by falling distance the
next ones are chosen as they stand, unless an earlier one of them lies nearer than their own distance. A round

1. takes the ``CANDIDATES`` farthest points and leaves out those that an earlier one lowers, which is lowered by none
   itself. What is left is chosen as far as it is above everything it was not compared with: the points outside of the
   table, and what those that were left out fall to;
2. brings the distances of all points up to date for the points chosen, but only in blocks of neighbours that are nearer to
   a chosen point than the farthest of their own points was. Most blocks are not.

Of 20,000 points 2,048 are chosen in about fifty rounds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import onnx_ir as ir

from attentionvote.export.graph_blocks import Blocks, squared_gap, squared_length
from attentionvote.export.graph_operators import BOOL, FLOAT, INT, constant, inner, value

CANDIDATES = 128
PASSES = 3  # over who lowers whom; chains are seldom longer, and what a longer one leaves open is for the next round
_BEYOND = 2**40  # more than any index


class _State(NamedTuple):
    """What a round leaves to the next: squared distances by block, the largest of each block, how many points are chosen,
    and which."""

    nearest: ir.Value
    largest: ir.Value
    done: ir.Value
    order: ir.Value


def farthest_points(op: Any, planes: ir.Value, blocks: Blocks, count: int) -> ir.Value:
    """``(count,)`` indices, each of the point farthest from all before it, from point 0 on; ties to the lowest index.

    Args:
        op: the builder.
        planes: ``(3, points)``.
        blocks: the same points.
        count: at least 1.
    """
    first = op.Unsqueeze(op.Slice(planes, [0], [1], [1]), [2])
    nearest = squared_length(op, op.Sub(blocks.points, first))
    # When all distances are 0, the lowest index is chosen for ever: it is there from the beginning.
    order = constant(op, np.zeros(count + CANDIDATES, np.int64))
    start = _State(nearest, op.ReduceMax(nearest, [1], keepdims=0), constant(op, [1]), order)

    def step(op: Any, number: ir.Value, before: ir.Value, *state: ir.Value) -> tuple[ir.Value, ...]:
        after = _round(op, planes, blocks, _State(*state))
        somewhere = op.Greater(op.ReduceMax(after.largest, [0]), 0.0)
        return op.And(op.Less(after.done, constant(op, [count])), somewhere), *after

    kinds = (FLOAT, blocks.shape), (FLOAT, blocks.shape[:1]), (INT, (1,)), (INT, (count + CANDIDATES,))
    spaces = [[value(f"{name}_{end}", *kind) for name, kind in zip(_State._fields, kinds, strict=True)] for end in "io"]
    body = inner(
        op,
        "round",
        step,
        [value("number", INT, ()), value("before", BOOL, (1,)), *spaces[0]],
        [value("more", BOOL, (1,)), *spaces[1]],
    )
    more = op.And(op.Greater(op.ReduceMax(start.largest, [0]), 0.0), constant(op, [count > 1]))
    return op.Slice(op.Loop(None, more, *start, body=body, _outputs=len(start))[-1], [0], [count])


def _round(op: Any, planes: ir.Value, blocks: Blocks, state: _State) -> _State:
    """The state after a round."""
    chosen = _choose(op, planes, blocks, state.nearest)
    number = op.Shape(chosen)
    places = op.Add(state.done, op.Slice(constant(op, np.arange(CANDIDATES)), [0], number))
    order = op.ScatterElements(state.order, places, chosen, axis=0)
    points = op.Unsqueeze(op.Gather(planes, chosen, axis=1), [2])
    pairs = op.NonZero(op.Less(squared_gap(op, blocks, points, points), state.largest))
    point, block = op.Gather(pairs, 0, axis=0), op.Gather(pairs, 1, axis=0)
    squared = squared_length(op, op.Sub(op.Gather(blocks.points, block, axis=1), op.Gather(points, point, axis=1)))
    # Not ScatterND: onnxruntime runs that on several threads, and two points may change the same block.
    rows = op.Expand(op.Unsqueeze(block, [1]), [1, blocks.shape[1]])
    nearest = op.ScatterElements(state.nearest, rows, squared, axis=0, reduction="min")
    return _State(nearest, op.ReduceMax(nearest, [1], keepdims=0), op.Add(state.done, number), order)


def _choose(op: Any, planes: ir.Value, blocks: Blocks, nearest: ir.Value) -> ir.Value:
    """The indices of the next points, at least one, given every point's squared distance from those before."""
    squared, candidate, bound, alike = _farthest(op, blocks, nearest)
    size = min(CANDIDATES, blocks.shape[0] * blocks.shape[1])
    points = op.Gather(planes, candidate, axis=1)
    table = squared_length(op, op.Sub(op.Unsqueeze(points, [2]), op.Unsqueeze(points, [1])))
    earlier = constant(op, np.triu(np.ones((size, size), bool), 1))
    lowers = op.Cast(op.And(op.Less(table, squared), earlier), to=FLOAT)  # row: by whom; column: whom
    # Who is lowered by nobody who is lowered by nobody ...: right for the first of them, and further with every pass.
    free = constant(op, np.ones((1, size), np.float32))
    for _ in range(PASSES + 1):
        before, free = free, op.Relu(op.Sub(1.0, op.MatMul(free, lowers)))
    numbers = constant(op, np.arange(size)[None])
    settled = op.Less(numbers, op.ReduceMin(op.Where(op.Equal(free, before), size, numbers), [1]))
    fallen = op.ReduceMax(op.Mul(op.Mul(table, lowers), op.Transpose(free, perm=[1, 0])), keepdims=0)
    # Of equally far points those outside have higher indices (see _farthest), and only then.
    above = op.Greater(squared, op.Where(alike, fallen, op.Max(bound, fallen)))
    chosen = op.And(op.And(above, settled), op.Greater(free, 0.0))
    return op.Gather(candidate, op.Gather(op.NonZero(chosen), 1, axis=0))


def _farthest(op: Any, blocks: Blocks, nearest: ir.Value) -> tuple[ir.Value, ...]:
    """The candidates: squared distances, falling, of equal ones the lowest index first; indices; the last distance, which
    no point outside exceeds; whether all are alike. Then there may be more of them, and these have the lowest indices."""
    places = blocks.shape[0] * blocks.shape[1]
    size = min(CANDIDATES, places)
    flat, index = op.Reshape(nearest, [places]), op.Reshape(blocks.index, [places])
    squared, place = op.TopK(flat, [size], largest=1, sorted=1, _outputs=2)
    most, bound = op.Slice(squared, [0], [1]), op.Slice(squared, [size - 1], [size])
    alike = op.Equal(most, bound)

    def lowest(op: Any) -> ir.Value:
        among = op.Where(op.Equal(flat, most), index, constant(op, _BEYOND))
        return op.TopK(among, [size], largest=0, sorted=1, _outputs=2)[0]

    candidate = op.If(
        alike,
        then_branch=inner(op, "alike", lowest, [], [value("lowest", INT, (size,))]),
        else_branch=inner(op, "apart", lambda op: op.Gather(index, place), [], [value("farthest", INT, (size,))]),
    )
    candidate, rank = op.TopK(candidate, [size], largest=0, sorted=1, _outputs=2)
    squared, rank = op.TopK(op.Gather(squared, rank), [size], largest=1, sorted=1, _outputs=2)
    return squared, op.Gather(candidate, rank), bound, alike
