"""A second look at every proposal in the frame of its own predicted pose. Not in the paper.

The paper regresses the pose from votes gathered in a small ball; what then limits the accuracy at 2 % of the
diameter is that one feature vector must encode any rotation. Seen from the predicted pose, the part's points lie
almost where the CAD model has them, and the remaining error is small and the same problem for every instance. A
shared PointNet looks at the measured points inside the part's box at that pose and regresses the remaining
translation and rotation, and how good the result will be. It is a layer of the network (learned, no
correspondences, no iteration to convergence), not a refinement afterwards like ICP; ``refinement=null`` is the
paper's form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.geometry import native
from attentionvote.model.constants import Constant
from attentionvote.model.kernels import kernels
from attentionvote.model.layers import RowNorm, shared_mlp
from attentionvote.model.pooled_mlp import pooled_mlp, pooled_mlp_weights
from attentionvote.model.precision import full_precision, widened
from attentionvote.model.rotation import matrix_from_six
from attentionvote.model.row_threads import in_threads
from attentionvote.model.settings import RefinementSettings

CHANNELS = 6
MOST_NUMBERS = 2**26  # of one table of points by rows: 256 MB, where all proposals of a paper-sized batch need 1 GB


class Refined(NamedTuple):
    """Corrected poses: centre ``(rows, 3)``, rotation ``(rows, 3, 3)``, and their score ``(rows,)``."""

    center: Tensor
    rotation: Tensor
    score: Tensor


def points_in_box_reference(
    points: Float[Tensor, "batch points 3"],
    normals: Float[Tensor, "batch points 3"],
    sample: Int[Tensor, " rows"],
    center: Float[Tensor, "rows 3"],
    rotation: Float[Tensor, "rows 3 3"],
    box: Float[Tensor, "2 3"],
    scale: float,
    count: int,
) -> Float[Tensor, "rows count 6"]:
    """The first ``count`` points in index order inside the part's box at each pose, in the part frame.

    Args:
        points, normals: camera frame, metres.
        sample: which sample of the batch each row belongs to.
        center, rotation: ``camera_from_part`` of each row.
        box: lowest and highest corner in the part frame, metres.
        scale: multiplies the positions (1 / D: order one).
        count: points a row; fewer are repeated in turn, none gives zeros.
    """
    # [b, n, 3] -> [r, n, 3], from the centres [r, 1, 3]
    local = (points[sample] - center[:, None]) @ rotation
    turned = normals[sample] @ rotation
    inside = ((local >= box[0]) & (local <= box[1])).all(-1)
    order = torch.arange(points.shape[1], 0, -1, device=points.device, dtype=points.dtype)
    rank, index = torch.topk(torch.where(inside, order, torch.zeros_like(order)), min(count, points.shape[1]), dim=1)
    inside_count = (rank > 0).sum(1, keepdim=True)
    # [r, min(count, n)] -> [r, count]
    index = torch.take_along_dim(index, torch.arange(count, device=points.device) % inside_count.clamp(min=1), dim=1)
    # [r, n, 6] -> [r, count, 6]
    picked = torch.take_along_dim(torch.cat([local * scale, turned], -1), index[..., None], dim=1)
    return picked * (inside_count > 0).to(picked.dtype)[..., None]


def points_in_box(
    points: Float[Tensor, "batch points 3"],
    normals: Float[Tensor, "batch points 3"],
    sample: Int[Tensor, " rows"],
    center: Float[Tensor, "rows 3"],
    rotation: Float[Tensor, "rows 3 3"],
    box: Float[Tensor, "2 3"],
    scale: float,
    count: int,
) -> Float[Tensor, "rows count 6"]:
    """``points_in_box_reference`` by the fastest means at hand, some rows at a time; carries no gradient."""
    library = kernels("network_ops.c", points)
    if library is None:
        rows = max(1, MOST_NUMBERS // (CHANNELS * points.shape[1]))
        if torch.compiler.is_compiling() or len(center) <= rows:
            return points_in_box_reference(points, normals, sample, center, rotation, box, scale, count)
        pieces = zip(sample.split(rows), center.split(rows), rotation.split(rows), strict=True)
        return torch.cat([points_in_box_reference(points, normals, *piece, box, scale, count) for piece in pieces])
    out = torch.empty(len(center), count, CHANNELS)
    p, m, s, c, r, b = (
        t.detach().contiguous().numpy() for t in (points, normals, sample.long(), center, rotation, box)
    )
    settings = b[0], b[1], float(scale), count

    def work(_: int, *rows: int) -> None:
        size, ends = points.shape[1], map(native.long, rows)
        native.call(library.points_in_box, p, m, size, s, c, r, *ends, *settings, out.numpy())

    in_threads(len(center), work, least=1)
    return out


class Refiner(nn.Module):
    """Corrects poses by looking at the measured points from the predicted pose.

    Args:
        settings: how many points around a pose are looked at, the shared MLP over them, whose maximum describes what is
            left to correct, and the MLP after the maximum.
        diameter: D in metres.
        box: lowest and highest corner of the part in its own frame, metres.
        context: channels of the proposal's own feature, appended to the maximum.
    """

    def __init__(
        self, settings: RefinementSettings, diameter: float, box: Sequence[Sequence[float]], context: int
    ) -> None:
        super().__init__()
        self.diameter, self.points = diameter, settings.points
        self.scale = 2.0 / diameter  # positions looked at are of order one
        self.identity = Constant(torch.tensor([1.0, 0, 0, 0, 1.0, 0]))
        margin = 0.06 * diameter
        corners = torch.tensor(box, dtype=torch.float32) + torch.tensor([[-margin], [margin]])
        self.box: Tensor
        self.register_buffer("box", corners)
        self.weights = pooled_mlp_weights(CHANNELS, settings.widths)
        self.norm = RowNorm(settings.widths[-1])
        self.mlp = shared_mlp(settings.widths[-1] + context, settings.head)
        self.output = nn.Linear(settings.head[-1], 10)
        nn.init.normal_(self.output.weight, std=1e-3)
        nn.init.zeros_(self.output.bias)

    def forward(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        sample: Int[Tensor, " rows"],
        center: Float[Tensor, "rows 3"],
        rotation: Float[Tensor, "rows 3 3"],
        context: Float[Tensor, "rows channels"],
    ) -> Refined:
        """One correction; the given pose is taken as a measurement and gets no gradient."""
        center, rotation = center.detach(), rotation.detach()
        with full_precision(points.device):
            seen = points_in_box(points, normals, sample, center, rotation, self.box, self.scale, self.points)
        nobody = torch.zeros(seen.shape[:2], dtype=torch.long, device=seen.device)
        return self.correct(pooled_mlp(seen, None, nobody, list(self.weights)), center, rotation, context)

    def correct(
        self,
        pooled: Float[Tensor, "rows width"],
        center: Float[Tensor, "rows 3"],
        rotation: Float[Tensor, "rows 3 3"],
        context: Float[Tensor, "rows channels"],
    ) -> Refined:
        """The corrected poses, given the maximum over the points that were looked at."""
        pooled = torch.relu(self.norm(pooled))
        out = widened(self.output(self.mlp(torch.cat([pooled, context], dim=-1))))
        # [r, 10] -> [r, 3], [r, 6] and [r]
        offset, six, score = out[:, :3], out[:, 3:9], out[:, 9]
        with full_precision(center.device):
            # [r, 3, 3] @ [r, 3, 1] -> [r, 3]
            shift = (rotation @ offset[:, :, None])[..., 0] * (0.1 * self.diameter)
            turn = matrix_from_six(self.identity.like(six) + 0.3 * six)
            return Refined(center + shift, rotation @ turn, score)
