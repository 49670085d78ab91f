"""Ball query in the exported graph: a few centres that lie together, and the blocks of points within their reach.

"The first k in index order" is TopK over the indices of the points inside. What it costs then is what TopK costs; before,
every centre was compared with every point.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx_ir as ir

from attentionvote.export.graph_blocks import NOWHERE, Blocks, in_blocks, squared_gap, squared_length
from attentionvote.export.graph_operators import FLOAT, INT, constant, inner, value

CHUNK = 16  # centres a step


def ball_query(op: Any, blocks: Blocks, centers: ir.Value, number: int, radius: float, count: int) -> ir.Value:
    """``(centers, count)`` indices: the first ``count`` points in index order within ``radius`` of each centre.

    Short balls are padded with their first. Every centre is one of the points, so no ball is empty.

    Args:
        op: the builder.
        blocks: the points; of at least ``count`` each.
        centers: ``(3, centers)``.
        number: of centres.
        radius: metres.
        count: the most points of a ball.
    """
    together = in_blocks(op, centers, number, CHUNK)
    limit = constant(op, np.float32(radius) * np.float32(radius))

    def step(op: Any, carry: ir.Value, centers: ir.Value) -> tuple[ir.Value, ir.Value]:
        low, high = (op.Unsqueeze(reduce(centers, [1], keepdims=1), [2]) for reduce in (op.ReduceMin, op.ReduceMax))
        near = op.LessOrEqual(squared_gap(op, blocks, low, high), limit)
        block = op.Gather(op.NonZero(near), 1, axis=0)
        points = op.Reshape(op.Gather(blocks.points, block, axis=1), [3, 1, -1])
        label = op.Reshape(op.Gather(blocks.label, block, axis=0), [1, -1])
        squared = squared_length(op, op.Sub(points, op.Unsqueeze(centers, [2])))
        inside = op.Where(op.LessOrEqual(squared, limit), label, NOWHERE)
        found, _ = op.TopK(inside, [count], axis=1, largest=0, sorted=1, _outputs=2)
        found = op.Where(op.Less(found, NOWHERE), found, op.Slice(found, [0], [1], [1]))
        return op.Identity(carry), found

    body = inner(
        op,
        "ball",
        step,
        [value("carry", FLOAT, [1]), value("together", FLOAT, [3, CHUNK])],
        [value("carried", FLOAT, [1]), value("found", FLOAT, [CHUNK, count])],
    )
    rows = op.Transpose(together.points, perm=[1, 0, 2])
    found = op.Scan(constant(op, np.zeros(1, np.float32)), rows, body=body, num_scan_inputs=1, _outputs=2)[1]
    found = op.Reshape(found, [-1, count])
    _, place = op.TopK(op.Reshape(together.label, [-1]), [number], largest=0, sorted=1, _outputs=2)
    return op.Cast(op.Gather(found, place, axis=0), to=INT)
