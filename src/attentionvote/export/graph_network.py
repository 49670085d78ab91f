"""The network as the exporter sees it: the same modules and weights, with neighbours found inside the graph.

Not a second network: ``ExportNetwork`` calls ``AttentionVote.forward`` itself. Only what a CPU runtime needs in
another order is replaced, layer by layer: the shared MLPs with their maximum, and the view of the refinement, go
through a ``scan`` over a few rows at a time, so that the activations stay in the cache (the largest single gain of
the exported graph).
"""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch._higher_order_ops.scan import scan

from attentionvote.export.graph_neighbors import farthest_point_order, find_neighborhoods
from attentionvote.model import AttentionVote, Predictions
from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.farthest_votes import FarthestVotes
from attentionvote.model.point_features import pair_features_reference
from attentionvote.model.pooled_mlp import pooled_mlp_reference
from attentionvote.model.refinement import Refined, Refiner

Kind = TypeVar("Kind", bound=nn.Module)
_ROWS = 1024  # neighbours a step: a few hundred kilobytes of activations


class GraphSetAbstraction(nn.Module):
    """``SetAbstraction`` of a batch of one, a few centres at a time."""

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
        points, directions, weights = xyz[0], normals[0], list(self.layer.weights)
        projected = None
        if self.layer.project is not None and features is not None:
            projected = self.layer.project(features[0])
        chunk = _chunk(neighbors.shape[1], neighbors.shape[2])
        blocks = tuple(t.reshape(-1, chunk, t.shape[-1]) for t in (centers, center_normals, neighbors))

        def step(carry: Tensor, block: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            middle, direction, index = block
            geometry = pair_features_reference(points, directions, middle, direction, index, self.layer.radius)
            return carry.clone(), pooled_mlp_reference(geometry, projected, index, weights)

        _, pooled = scan(step, torch.zeros(1), blocks)
        return self.layer.finish(pooled.reshape(neighbors.shape[1], -1))[None]


class GraphRefiner(nn.Module):
    """``Refiner`` of a batch of one, a few poses at a time."""

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
        chunk = _chunk(len(center), layer.points)
        # Around the middle of the cloud: float32 has more digits there.
        middle = points[0].mean(0)
        columns = torch.cat([points[0] - middle, torch.ones(total, 1)], dim=1).T.contiguous()
        cloud = torch.cat([points[0], normals[0]], dim=1)
        low, high = (corner.view(3, 1, 1).clone() for corner in layer.box)
        scale = torch.tensor([layer.scale] * 3 + [1.0] * 3)
        # First in index order = largest of a falling rank; 0 for a point outside.
        rank = torch.arange(total, 0, -1, dtype=torch.float32)

        def step(carry: Tensor, poses: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            center, turn = poses
            shift = (center - middle)[:, None] @ turn
            rows = torch.cat([turn.transpose(1, 2), -shift.transpose(1, 2)], dim=2).transpose(0, 1)
            local = (rows.reshape(3 * chunk, 4) @ columns).view(3, chunk, total)
            x, y, z = torch.minimum(local - low, high - local).unbind(0)
            inside = torch.minimum(torch.minimum(x, y), z) >= 0
            found, index = torch.topk(torch.where(inside, rank, torch.zeros_like(rank)), count, dim=1)
            number = (found > 0).sum(1, keepdim=True)
            index = torch.gather(index, 1, torch.arange(layer.points) % number.clamp(min=1))
            offset = torch.cat([center, torch.zeros_like(center)], dim=1)[:, None]
            seen = (cloud[index] - offset).view(chunk, 2 * layer.points, 3) @ turn
            seen = seen.view(chunk, layer.points, 6) * scale * (number > 0).to(seen.dtype)[:, None]
            return carry.clone(), pooled_mlp_reference(seen, None, index, weights)

        blocks = (center.view(-1, chunk, 3), rotation.view(-1, chunk, 3, 3))
        _, pooled = scan(step, torch.zeros(1), blocks)
        return layer.correct(pooled.view(len(center), -1), center, rotation, context)


class GraphFarthestVotes(FarthestVotes):
    """``FarthestVotes`` of a batch of one: the farthest-point Scan that also orders the cloud."""

    def forward(self, votes: Float[Tensor, "1 votes 3"], count: int) -> Int[Tensor, "1 count"]:
        """Indices of the sampled votes."""
        return farthest_point_order(votes[0], count)[None]


class ExportNetwork(nn.Module):
    """Points and normals in, poses out, nothing else needed: ``AttentionVote`` for a batch of one.

    Args:
        model: a trained network; its weights are shared, it is not changed.
    """

    def __init__(self, model: AttentionVote) -> None:
        super().__init__()
        model = _shallow(model)
        model.backbone = _shallow(model.backbone)
        model.backbone.abstractions = nn.ModuleList(
            GraphSetAbstraction(layer) for layer in _layers(model.backbone.abstractions, SetAbstraction)
        )
        model.refiners = nn.ModuleList(GraphRefiner(layer) for layer in _layers(model.refiners, Refiner))
        if model.farthest is not None:
            model.farthest = GraphFarthestVotes()
        self.model = model.eval()

    def forward(self, points: Float[Tensor, "1 points 3"], normals: Float[Tensor, "1 points 3"]) -> Predictions:
        """What ``AttentionVote.forward`` answers for the same cloud."""
        predictions: Predictions = self.model(points, normals, find_neighborhoods(points, self.model.layout))
        return predictions


def _layers(modules: nn.ModuleList, kind: type[Kind]) -> list[Kind]:
    """The modules of a list, which are all of one kind."""
    return [module for module in modules if isinstance(module, kind)]


def _shallow(module: Kind) -> Kind:
    """A module with the same weights whose children can be replaced without the original noticing."""
    twin = copy.copy(module)
    twin._modules = dict(module._modules)
    return twin


def _chunk(rows: int, neighbors: int) -> int:
    """Centres a step: the largest number that divides ``rows`` and keeps to ``_ROWS`` neighbours."""
    return next(n for n in range(max(1, min(rows, _ROWS // neighbors)), 0, -1) if rows % n == 0)
