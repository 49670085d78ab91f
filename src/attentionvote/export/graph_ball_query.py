"""Ball query in the exported graph: a few centres that lie together, and the blocks of points within their reach.

"The first k in index order" is TopK over the indices of the points inside. What it costs is what TopK costs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx_ir as ir

from attentionvote.export.graph_blocks import NOWHERE, Blocks, in_blocks, squared_gap, squared_length
from attentionvote.export.graph_operators import BOOL, FLOAT, INT, constant, inner, value

CHUNK = 16  # centres a step


def ball_query(op: Any, blocks: Blocks, centers: ir.Value, number: int, radius: float, count: int) -> ir.Value:
    """``(number, count)`` indices: the first ``count`` points in index order within ``radius`` of each centre.

    Short balls are padded with their first. Every centre is one of the points, so no ball is empty.

    Args:
        op: the builder.
        blocks: the points, in blocks of at least ``count`` places.
        centers: ``(3, number)``.
        number: of centres.
        radius: metres.
        count: the most points of a ball.
    """
    together = in_blocks(op, centers, number, CHUNK)
    limit = constant(op, np.float32(radius) * np.float32(radius))
    corners = (op.Reshape(corner, [3, -1, 1]) for corner in (together.low, together.high))
    within_reach = op.Squeeze(op.LessOrEqual(squared_gap(op, blocks, *corners), limit), [0])

    def step(op: Any, carry: ir.Value, centers: ir.Value, reach: ir.Value) -> tuple[ir.Value, ir.Value]:
        block = op.Gather(op.NonZero(reach), 0, axis=0)
        points = op.Reshape(op.Gather(blocks.points, block, axis=1), [3, 1, -1])
        label = op.Reshape(op.Gather(blocks.label, block, axis=0), [-1])
        inside = op.LessOrEqual(squared_length(op, op.Sub(points, centers)), limit)
        nearest_labels, _ = op.TopK(op.Where(inside, label, NOWHERE), [count], axis=2, largest=0, sorted=1, _outputs=2)
        return op.Identity(carry), nearest_labels

    body = inner(
        op,
        "ball",
        step,
        [value("carry", FLOAT, [1]), value("together", FLOAT, [3, CHUNK, 1]), value("reach", BOOL, blocks.shape[:1])],
        [value("carried", FLOAT, [1]), value("found", FLOAT, [1, CHUNK, count])],
    )
    chunks = op.Unsqueeze(op.Transpose(together.points, perm=[1, 0, 2]), [3])
    start = constant(op, np.zeros(1, np.float32))
    neighbors = op.Scan(start, chunks, within_reach, body=body, num_scan_inputs=2, _outputs=2)[1]
    # Back into the order of the centres; a place that repeats another centre comes last.
    _, position = op.TopK(op.Reshape(together.label, [-1]), [number], largest=0, sorted=1, _outputs=2)
    neighbors = op.Gather(op.Reshape(neighbors, [-1, count]), position, axis=0)
    neighbors = op.Where(op.Less(neighbors, NOWHERE), neighbors, op.Slice(neighbors, [0], [1], [1]))
    return op.Cast(neighbors, to=INT)
