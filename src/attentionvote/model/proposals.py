"""Centre seeds from votes: a heatmap without a grid, and its local peaks (paper section 3.2).

The paper counts votes in voxels and smooths with a sparse 3x3x3 Gaussian. Evaluated at occupied voxels only, that
is a sum over pairs of votes of a weight that depends on the integer difference of their voxels: M x M small
integers, no sparse-convolution library, no extent to choose, standard ONNX operators.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from attentionvote.geometry import native
from attentionvote.model.kernels import kernels
from attentionvote.model.precision import full_precision
from attentionvote.model.row_threads import in_threads

# The paper's kernel: 3x3x3, sigma one voxel, sum one: centre 0.0923, face 0.0560, edge 0.0339, corner 0.0206.
SIDE = math.exp(-0.5)
CENTER = 1.0 / (1.0 + 2.0 * SIDE) ** 3
TIE = 1e-4  # heats closer than this are equal: a thousandth of a vote, far above the rounding of a sum of hundreds


class Peaks(NamedTuple):
    """Local peaks of the heatmap, hottest first; places beyond the last peak have heat 0.

    Attributes:
        center_seed: ``(batch, K, 3)`` metres.
        heat: ``(batch, K)`` smoothed vote count.
        vote_heat: ``(batch, M)`` heat of every vote's own voxel.
    """

    center_seed: Tensor
    heat: Tensor
    vote_heat: Tensor


def heatmap_peaks(
    votes: Float[Tensor, "batch votes 3"],
    voxel_size: float,
    count: int,
    window: int = 1,
    center_seed: str = "mean",
    heatmap: nn.Module | None = None,
) -> Peaks:
    """The ``count`` hottest local peaks.

    A voxel is a peak when no occupied voxel within ``window`` voxels (in every axis) has more heat, or as much and
    holds an earlier vote. ``window`` 1 is the paper's 3x3x3 maximum; a wider one merges the two peaks that the votes
    of one instance leave when they are scattered over several voxels.

    Args:
        votes: metres.
        voxel_size: metres.
        count: K; when there are fewer peaks the rest has heat 0 and some vote's position.
        window: half width of the neighbourhood in voxels.
        center_seed: ``voxel`` for the voxel's centre (the paper's), ``mean`` for the heat-weighted mean of the votes
            in the 3x3x3 voxels, which does not jump with the grid.
        heatmap: what stands in for ``Heatmap``.
    """
    with full_precision(votes.device):
        heat, beaten, mean = (heatmap or Heatmap())(votes, voxel_size, window)
    height = heat * (1.0 - beaten)
    # Equal heats in the order of their votes, whatever computes the sum: the same peaks in training and in the cell.
    total = votes.shape[1]
    later = torch.arange(total, device=votes.device)
    at = torch.topk(torch.round(height / TIE).long() * total - later, min(count, total), dim=1)[1]
    # [b, m] -> [b, k]
    peak_heat = torch.take_along_dim(height, at, dim=1)
    seeds = mean if center_seed == "mean" else (torch.floor(votes / voxel_size) + 0.5) * voxel_size
    batch = torch.arange(len(votes), device=votes.device)[:, None]
    # [b, m, 3] -> [b, k, 3]
    return Peaks(seeds[batch, at], peak_heat, heat)


def heatmap_reference(
    votes: Float[Tensor, "batch votes 3"], voxel_size: float, window: int
) -> tuple[Float[Tensor, "batch votes"], Float[Tensor, "batch votes"], Float[Tensor, "batch votes 3"]]:
    """Heat of each vote's voxel, 1 where a hotter or earlier vote is near, and the heat-weighted mean of the votes."""
    voxel = torch.floor(votes / voxel_size)
    # Axis by axis, [b, m, 1] - [b, 1, m]: matrices M x M stay contiguous, which a last dimension of three would not.
    x, y, z = (a[:, :, None] - a[:, None] for a in voxel.unbind(-1))
    # exp(-d^2 / 2) at d = 0 and +-1, and 0 beyond: exact on integers.
    gx, gy, gz = (torch.relu(1.0 - (1.0 - SIDE) * d.square()) for d in (x, y, z))
    weight = CENTER * (gx * gy * gz)
    heat = weight.sum(-1)
    near = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs()) <= window
    index = torch.arange(votes.shape[1], device=votes.device)
    # Equal voxels have equal heat only up to the order of summation; the tolerance restores the tie.
    # [b, 1, m] - [b, m, 1] -> [b, m, m]
    ahead = heat[:, None] - heat[:, :, None]
    earlier = index[None, :] < index[:, None]
    beaten = near & ((ahead > TIE) | ((ahead.abs() <= TIE) & earlier))
    # [b, m, m] @ [b, m, 3] / [b, m, 1] -> [b, m, 3]
    return heat, beaten.to(heat.dtype).amax(-1), weight @ votes / heat[..., None]


class Heatmap(nn.Module):
    """``heatmap_reference`` by the fastest means at hand; a module, so that the exporter can replace it."""

    def forward(
        self, votes: Float[Tensor, "batch votes 3"], voxel_size: float, window: int
    ) -> tuple[Float[Tensor, "batch votes"], Float[Tensor, "batch votes"], Float[Tensor, "batch votes 3"]]:
        """What ``heatmap_reference`` answers."""
        library = kernels("network_ops.c", votes)
        if library is None:
            return heatmap_reference(votes, voxel_size, window)
        batch, count, _ = votes.shape
        heat, beaten, mean = torch.empty(batch, count), torch.empty(batch, count), torch.empty(batch, count, 3)
        inputs, out = votes.detach().contiguous().numpy(), [t.numpy() for t in (heat, beaten, mean)]
        settings = float(voxel_size), window, CENTER, SIDE, TIE

        def work(_: int, *samples: int) -> None:
            native.call(library.heatmap, inputs, *map(native.long, samples), count, *settings, *out)

        in_threads(batch, work, least=1)
        return heat, beaten, mean


def gather_votes_reference(
    votes: Float[Tensor, "batch votes 3"],
    center_seed: Float[Tensor, "batch proposals 3"],
    radius: float,
    count: int,
) -> Tensor:
    """Indices ``(batch, proposals, count)`` of votes within ``radius`` of each centre seed (Eqs. 2 and 3).

    The first ``count`` in index order, repeated in turn when there are fewer; the nearest vote when there is none.
    Votes come in farthest-point order of their seeds, so the first ones are spread over the visible surface. The
    paper draws at random with repetition; this choice is deterministic and needs no other form at export.
    """
    # [b, k, 1, 3] - [b, 1, m, 3] -> [b, k, m]
    squared = (center_seed[:, :, None] - votes[:, None]).square().sum(-1)
    total = votes.shape[1]
    order = torch.arange(total, 0, -1, device=votes.device, dtype=votes.dtype)
    inside = squared <= radius * radius
    nearest = squared.argmin(-1)
    rank, index = torch.topk(torch.where(inside, order, -squared), min(count, total), dim=-1)
    inside_count = (rank > 0).sum(-1, keepdim=True)
    # [b, k, min(count, m)] -> [b, k, count]
    position = torch.arange(count, device=votes.device) % inside_count.clamp(min=1)
    index = torch.take_along_dim(index, position, dim=-1)
    return torch.where(inside_count > 0, index, nearest[..., None])


def gather_votes(
    votes: Float[Tensor, "batch votes 3"],
    center_seed: Float[Tensor, "batch proposals 3"],
    radius: float,
    count: int,
) -> Tensor:
    """``gather_votes_reference`` by the fastest means at hand; carries no gradient."""
    library = kernels("network_ops.c", votes, center_seed)
    if library is None:
        return gather_votes_reference(votes, center_seed, radius, count)
    batch, total, _ = votes.shape
    out = torch.empty(batch, center_seed.shape[1], count, dtype=torch.long)
    inputs = [t.detach().contiguous().numpy() for t in (votes, center_seed)]
    settings = total, center_seed.shape[1], radius * radius, count

    def work(_: int, *samples: int) -> None:
        native.call(library.votes_around, *inputs, *map(native.long, samples), *settings, out.numpy())

    in_threads(batch, work, least=1)
    return out
