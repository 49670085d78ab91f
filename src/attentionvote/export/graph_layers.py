"""Layers of the network in the order of work that suits a CPU runtime: a few rows at a time, in the cache.

Each does, for a batch of one, what the layer of ``model`` does that it stands for. Shared MLPs with their maximum, the
view of the refinement and the heatmap go through a ``Scan``, so that what they make on the way stays in the cache: the
largest single gain of the exported graph. Points are gathered by rows but calculated with by planes, x and y and z
apart, because sums over a last dimension of three are slow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding, linear

from attentionvote.export.graph_neighbors import farthest_point_order
from attentionvote.export.graph_scan import in_blocks
from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.farthest_votes import FarthestVotes
from attentionvote.model.point_features import TINY
from attentionvote.model.proposals import CENTER, SIDE, TIE, Heatmap
from attentionvote.model.refinement import Refined, Refiner

_ROWS = 1024  # neighbours a step: a few hundred kilobytes of activations
_POSES = 8
_PAIRS = 65536  # pairs of votes a step
_JUST_BELOW = float(np.nextafter(np.float32(-TIE), np.float32(-1)))  # more than this is -TIE or more


class GraphSetAbstraction(nn.Module):
    """``SetAbstraction``, a few centres at a time."""

    def __init__(self, layer: SetAbstraction) -> None:
        super().__init__()
        self.layer = layer

    def forward(
        self,
        xyz: Float[Tensor, "1 points 3"],
        normals: Float[Tensor, "1 points 3"],
        features: Float[Tensor, "1 points channels"] | None,
        centers: Float[Tensor, "1 centers 3"],
        center_normals: Float[Tensor, "1 centers 3"],
        neighbors: Int[Tensor, "1 centers neighbors"],
    ) -> Float[Tensor, "1 centers out"]:
        """Features of the centres."""
        layer, weights = self.layer, list(self.layer.weights)
        _, count, near = neighbors.shape
        chunk = _divisor(count, _ROWS // near)
        cloud = torch.cat([xyz[0], normals[0]], dim=1)
        middles = torch.cat([centers[0], center_normals[0]], dim=1).view(-1, chunk, 6)
        first, projected = _first_layer(weights[0], layer.radius), []
        if layer.project is not None and features is not None:
            projected = [layer.project(features[0])]

        def step(block: Sequence[Tensor], shared: tuple[Tensor, Tensor, list[Tensor], list[Tensor]]) -> list[Tensor]:
            (middle, index), (cloud, first, weights, projected) = block, shared
            hidden = linear(_pair_features(embedding(index, cloud), middle).T, first, weights[1])
            for features in projected:
                hidden = hidden + embedding(index, features)
            return [_pooled(hidden, weights, chunk)]

        blocks = (middles, neighbors.view(-1, chunk * near))
        (pooled,) = in_blocks(step, blocks, (cloud, first, weights, projected))
        return layer.finish(pooled.reshape(count, -1))[None]


def _pair_features(near: Float[Tensor, "rows 6"], middle: Float[Tensor, "centers 6"]) -> Float[Tensor, "channels rows"]:
    """What ``pair_features`` is made of, by planes, all neighbours of a centre in succession: offset, normal, distance,
    and the products whose sums are the cosines."""
    planes, center_planes = near.T.reshape(6, len(middle), -1), middle.T[:, :, None]
    offset, normal, center_normal = planes[:3] - center_planes[:3], planes[3:], center_planes[3:]
    squared = torch.ones(1, 3) @ (offset * offset).view(3, -1)
    distance = squared.sqrt().view(1, len(middle), -1)
    unit = offset / (distance + TINY)
    channels = torch.cat([offset, normal, distance, center_normal * unit, normal * unit, center_normal * normal])
    return channels.view(len(channels), -1)


def _first_layer(weight: Float[Tensor, "width 10"], radius: float) -> Float[Tensor, "width channels"]:
    """Weights of ``pair_features`` for what ``_pair_features`` answers."""
    offset, normal, distance, cosines = weight.split([3, 3, 1, 3], dim=1)
    return torch.cat([offset / radius, normal, distance / radius, cosines.repeat_interleave(3, dim=1)], dim=1)


def _pooled(hidden: Float[Tensor, "rows width"], weights: list[Tensor], chunk: int) -> Float[Tensor, "chunk out"]:
    """The shared MLP after its first layer, and the maximum over the rows of a centre."""
    for weight, bias in zip(weights[2::2], weights[3::2], strict=True):
        hidden = linear(torch.relu(hidden), weight, bias)
    return hidden.view(chunk, -1, hidden.shape[1]).max(dim=1)[0]


class GraphRefiner(nn.Module):
    """``Refiner``, a few poses at a time."""

    def __init__(self, layer: Refiner) -> None:
        super().__init__()
        self.layer = layer

    def forward(
        self,
        points: Float[Tensor, "1 points 3"],
        normals: Float[Tensor, "1 points 3"],
        sample: Int[Tensor, " rows"],
        center: Float[Tensor, "rows 3"],
        rotation: Float[Tensor, "rows 3 3"],
        context: Float[Tensor, "rows channels"],
    ) -> Refined:
        """One correction of every pose; ``sample`` is all zeros."""
        del sample
        layer, weights = self.layer, list(self.layer.weights)
        total, count = points.shape[1], min(layer.points, points.shape[1])
        chunk = _divisor(len(center), _POSES)
        # A fourth row of ones moves the box's middle to zero.
        planes = torch.cat([points[0], torch.ones(total, 1)], dim=1).T.contiguous()
        cloud = torch.cat([points[0], normals[0]], dim=1)
        half = (layer.box[1] - layer.box[0]) / 2
        shift = -((layer.box[1] + layer.box[0]) / 2 / half).view(1, 3, 1)
        scale = torch.tensor([layer.scale] * 3 + [1.0] * 3)
        # First in index order = largest of a falling rank; 0 for a point outside.
        rank = torch.arange(total, 0, -1, dtype=torch.float32)

        def step(poses: Sequence[Tensor], shared: tuple[dict[str, Tensor], list[Tensor]]) -> list[Tensor]:
            (center, turn), (fixed, weights) = poses, shared
            planes, rank, half = fixed["planes"], fixed["rank"], fixed["half"]
            # In units of the box around its middle: inside is what lies within one in every direction.
            away = planes - torch.cat([center, torch.zeros(chunk, 1)], dim=1)[:, :, None]
            shift = fixed["shift"].expand(chunk, 3, 1)
            box_from_camera = torch.cat([turn.transpose(1, 2) / half[:, None], shift], dim=2)
            x, y, z = (box_from_camera @ away).abs().unbind(1)
            inside = torch.maximum(torch.maximum(x, y), z) <= 1
            inside_rank, index = torch.topk(torch.where(inside, rank, torch.zeros_like(rank)), count, dim=1)
            number = (inside_rank > 0).sum(1, keepdim=True)
            index = torch.gather(index, 1, torch.arange(layer.points) % number.clamp(min=1))
            offset = torch.cat([center, torch.zeros_like(center)], dim=1)[:, None]
            seen = (embedding(index, fixed["cloud"]) - offset).view(chunk, 2 * layer.points, 3) @ turn
            seen = seen.view(chunk, layer.points, 6) * fixed["scale"] * (number > 0).to(seen.dtype)[:, None]
            return [_pooled(linear(seen.view(-1, 6), weights[0], weights[1]), weights, chunk)]

        blocks = (center.view(-1, chunk, 3), rotation.view(-1, chunk, 3, 3))
        fixed = {"planes": planes, "cloud": cloud, "half": half, "shift": shift, "scale": scale, "rank": rank}
        (pooled,) = in_blocks(step, blocks, (fixed, weights))
        return layer.correct(pooled.view(len(center), -1), center, rotation, context)


class GraphFarthestVotes(FarthestVotes):
    """``FarthestVotes`` by the operator that also orders the cloud."""

    def forward(self, votes: Float[Tensor, "1 votes 3"], count: int) -> Int[Tensor, "1 count"]:
        """Indices of the sampled votes."""
        return farthest_point_order(votes[0], count)[None]


class GraphHeatmap(Heatmap):
    """``Heatmap``, a few votes beside all at a time: first the heat of all, then who is beaten by whom."""

    def forward(
        self, votes: Float[Tensor, "1 votes 3"], voxel_size: float, window: int
    ) -> tuple[Float[Tensor, "1 votes"], Float[Tensor, "1 votes"], Float[Tensor, "1 votes 3"]]:
        """Heat, whether beaten, and the mean of the votes around."""
        places, total = votes[0], votes.shape[1]
        chunk = _divisor(total, _PAIRS // total)
        voxel = torch.floor(places / voxel_size).T
        columns = [plane.clone() for plane in voxel]
        blocks = voxel.T.reshape(-1, chunk, 3)

        def differences(block: Tensor, columns: list[Tensor]) -> list[Tensor]:
            return [a - b for a, b in zip(block.T[:, :, None].unbind(0), columns, strict=True)]

        def warm(block: Sequence[Tensor], shared: tuple[list[Tensor], Tensor]) -> list[Tensor]:
            columns, places = shared
            gx, gy, gz = (torch.relu(1.0 - (1.0 - SIDE) * (d * d)) for d in differences(block[0], columns))
            weight = CENTER * (gx * gy * gz)
            heat = weight.sum(1)
            return [heat, weight @ places / heat[:, None]]

        heat, mean = in_blocks(warm, [blocks], (columns, places))
        heat = heat.view(total)
        index = torch.arange(total, dtype=torch.float32)

        def beat(block: Sequence[Tensor], shared: tuple[list[Tensor], Tensor, Tensor]) -> list[Tensor]:
            (voxels, row_heat, number), (columns, heat, index) = block, shared
            dx, dy, dz = (d.abs() for d in differences(voxels, columns))
            near = torch.maximum(torch.maximum(dx, dy), dz) <= window
            least = torch.where(index < number[:, None], _JUST_BELOW, TIE)
            ahead = torch.where(near, heat - row_heat[:, None] - least, -1.0)
            return [(ahead.amax(1) > 0).to(heat.dtype)]

        rows = (blocks, heat.view(-1, chunk).clone(), index.view(-1, chunk).clone())
        (beaten,) = in_blocks(beat, rows, (columns, heat, index))
        return heat[None], beaten.view(1, total), mean.view(1, total, 3)


def _divisor(count: int, most: int) -> int:
    """The largest number up to ``most`` that divides ``count``."""
    return next(n for n in range(max(1, min(count, most)), 0, -1) if count % n == 0)
