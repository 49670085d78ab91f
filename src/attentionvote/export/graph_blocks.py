"""Points in small blocks of neighbours, so that the exported graph looks only where something can be near."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import onnx_ir as ir

from attentionvote.export.graph_operators import FLOAT, constant

NOWHERE = float(2**24)  # label of a spare place; float32 can tell all numbers below apart


class Blocks(NamedTuple):
    """Points in blocks, metres.

    Attributes:
        indices: ``(blocks, size)`` int64, of the points; spare places repeat one.
        label: the same as float32, but ``NOWHERE`` at spare places.
        points: ``(3, blocks, size)``.
        low, high: ``(3, 1, blocks)`` corners of their boxes.
        shape: blocks and places in each.
    """

    indices: ir.Value
    label: ir.Value
    points: ir.Value
    low: ir.Value
    high: ir.Value
    shape: tuple[int, int]


def in_blocks(op: Any, planes: ir.Value, count: int, size: int) -> Blocks:
    """Points in strips of equal count along x, each strip cut into blocks along y: ranks, so that strays do no harm.

    The view is from above the bin; a cloud that is a line along z has blocks without a shape, and is slow.

    Args:
        op: the builder.
        planes: ``(3, count)``.
        count, size: points in all and in a block.

    Raises:
        ValueError: when there are more points than labels.
    """
    if count >= NOWHERE:
        raise ValueError(f"count must be less than {NOWHERE:.0f} points, got {count}")
    strips = max(1, round((count / size) ** 0.5))
    blocks = strips * -(-count // (size * strips))
    spare = blocks * size - count
    _, along_x = op.TopK(op.Gather(planes, 0, axis=0), [count], largest=0, sorted=1, _outputs=2)
    label = op.Cast(along_x, to=FLOAT)
    if spare:
        along_x = op.Concat(along_x, op.Expand(op.Slice(along_x, [count - 1], [count]), [spare]), axis=0)
        label = op.Concat(label, constant(op, np.full(spare, NOWHERE, np.float32)), axis=0)
    rows = [strips, blocks // strips * size]
    y = op.Reshape(op.Gather(op.Gather(planes, 1, axis=0), along_x), rows)
    _, along_y = op.TopK(y, rows[1:], axis=1, largest=0, sorted=1, _outputs=2)
    index = op.Reshape(op.GatherElements(op.Reshape(along_x, rows), along_y, axis=1), [blocks, size])
    label = op.Reshape(op.GatherElements(op.Reshape(label, rows), along_y, axis=1), [blocks, size])
    points = op.Gather(planes, index, axis=1)
    low, high = (op.Unsqueeze(reduce(points, [2], keepdims=0), [1]) for reduce in (op.ReduceMin, op.ReduceMax))
    return Blocks(index, label, points, low, high, (blocks, size))


def squared_length(op: Any, differences: ir.Value) -> ir.Value:
    """``(3, ...)`` to ``(1, ...)``: x^2 + y^2 + z^2 in the order in which the C operators add."""
    x, y, z = op.Split(op.Mul(differences, differences), num_outputs=3, axis=0, _outputs=3)
    return op.Add(op.Add(x, y), z)


def squared_gap(op: Any, blocks: Blocks, low: ir.Value, high: ir.Value) -> ir.Value:
    """``(1, boxes, blocks)``: squared distance of each block's box from other boxes, ``(3, boxes, 1)`` their corners.

    Never more than the squared distance of two points in them, not even by rounding: every operation on the way is the
    same as for the points, and none of them reverses an order.
    """
    return squared_length(op, op.Relu(op.Max(op.Sub(blocks.low, high), op.Sub(low, blocks.high))))
