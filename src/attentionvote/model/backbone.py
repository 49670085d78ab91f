"""PPF-augmented PointNet++: four set abstractions, two feature propagations (paper section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.model.interpolation import interpolate
from attentionvote.model.layers import Residual, RowNorm, shared_mlp
from attentionvote.model.neighborhoods import Layout, Neighborhoods
from attentionvote.model.point_features import CHANNELS, pair_features
from attentionvote.model.pooled_mlp import pooled_mlp, pooled_mlp_weights


class SetAbstraction(nn.Module):
    """Features of centres from their neighbours: shared MLP, maximum, norm.

    PointNet++ normalises after every layer of the shared MLP; here one norm follows the maximum. It sees a row a
    centre instead of a row a neighbour, so it costs a thirtieth, and lets the MLP and the maximum run as one
    kernel. ``residual`` adds a pointwise block on the centres, which buys depth where rows are few.

    Args:
        width_in: channels of the level below, 0 for none.
        widths: output channels of the shared MLP's layers.
        radius: ball radius in metres, the unit of the offsets.
        residual: whether a residual block follows.
    """

    def __init__(self, width_in: int, widths: Sequence[int], radius: float, residual: bool) -> None:
        super().__init__()
        self.radius = radius
        self.project = nn.Linear(width_in, widths[0], bias=False) if width_in else None
        self.weights = pooled_mlp_weights(CHANNELS, widths)
        self.norm = RowNorm(widths[-1])
        self.residual = Residual(widths[-1]) if residual else nn.Identity()

    def forward(
        self,
        xyz: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        features: Float[Tensor, "batch points channels"] | None,
        centers: Float[Tensor, "batch centers 3"],
        center_normals: Float[Tensor, "batch centers 3"],
        neighbors: Int[Tensor, "batch centers neighbors"],
    ) -> Float[Tensor, "batch centers out"]:
        """Features of the centres; ``neighbors`` are indices into ``points``."""
        batch, count, _ = centers.shape
        # [b, s, h] indices within a sample -> [b * s, h] rows of all samples' points
        first_row = torch.arange(batch, device=xyz.device)[:, None, None] * xyz.shape[1]
        index = (neighbors + first_row).flatten(0, 1)
        # [b, n, 3] -> [b * n, 3], and of the centres [b, s, 3] -> [b * s, 3]
        flat = [t.reshape(-1, 3) for t in (xyz, normals, centers, center_normals)]
        geometry = pair_features(flat[0], flat[1], flat[2], flat[3], index, self.radius)
        projected = None
        if self.project is not None and features is not None:
            # [b, n, c] -> [b * n, c]
            projected = self.project(features.reshape(-1, features.shape[-1]))
        pooled = pooled_mlp(geometry, projected, index, list(self.weights))
        # [b * s, c] -> [b, s, c]
        return self.finish(pooled).view(batch, count, -1)

    def finish(self, pooled: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        """What follows the maximum: norm, ReLU, residual block."""
        out: Tensor = self.residual(torch.relu(self.norm(pooled)))
        return out


class FeaturePropagation(nn.Module):
    """Features of a finer level: inverse-distance mean of the three nearest coarse ones beside its own, then an MLP."""

    def __init__(self, width_coarse: int, width_fine: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.mlp = shared_mlp(width_coarse + width_fine, widths)

    def forward(
        self,
        coarse: Float[Tensor, "batch coarse channels"],
        fine: Float[Tensor, "batch fine fine_channels"],
        nearest: Int[Tensor, "batch fine 3"],
        weights: Float[Tensor, "batch fine 3"],
    ) -> Float[Tensor, "batch fine out"]:
        """Features at the fine level."""
        out: Tensor = self.mlp(interpolate(coarse, fine, nearest, weights))
        return out


class Backbone(nn.Module):
    """Points with normals to M seeds with features (paper section 3.1; sizes section 3.5, widths VoteNet's).

    Args:
        layout: sizes and radii of the levels.
        widths: output channels of the shared MLP of each set abstraction.
        propagation: output channels of the MLPs of both feature propagations; the last is F.
        residual: whether each set abstraction ends with a pointwise residual block.
    """

    def __init__(
        self, layout: Layout, widths: Sequence[Sequence[int]], propagation: Sequence[int], residual: bool
    ) -> None:
        super().__init__()
        self.layout = layout
        below = [0, *(w[-1] for w in widths[:-1])]
        self.abstractions = nn.ModuleList(
            SetAbstraction(a, w, r, residual) for a, w, r in zip(below, widths, layout.radii, strict=True)
        )
        top = [w[-1] for w in widths]
        self.propagation_3 = FeaturePropagation(top[3], top[2], propagation)
        self.propagation_2 = FeaturePropagation(propagation[-1], top[1], propagation)
        self.width = propagation[-1]

    def forward(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        neighborhoods: Neighborhoods,
    ) -> tuple[Float[Tensor, "batch seeds 3"], Float[Tensor, "batch seeds features"]]:
        """Positions and features of the seeds."""
        batch = torch.arange(len(points), device=points.device)[:, None]
        # [b, n, 3] -> [b, s, 3], s of the first level
        ordered, ordered_normals = points[batch, neighborhoods.order], normals[batch, neighborhoods.order]
        xyz, directions = points, normals
        features: Tensor | None = None
        levels: list[Tensor] = []
        for layer, size, neighbors in zip(self.abstractions, self.layout.centers, neighborhoods.neighbors, strict=True):
            # [b, s, 3] -> [b, size, 3]: every level's centres are a prefix
            centers, center_normals = ordered[:, :size], ordered_normals[:, :size]
            features = layer(xyz, directions, features, centers, center_normals, neighbors)
            levels.append(features)
            xyz, directions = centers, center_normals
        third = self.propagation_3(levels[3], levels[2], neighborhoods.nearest[0], neighborhoods.weights[0])
        seeds = self.propagation_2(third, levels[1], neighborhoods.nearest[1], neighborhoods.weights[1])
        # [b, s, 3] -> [b, m, 3]
        return ordered[:, : self.layout.seeds], seeds
