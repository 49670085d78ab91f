"""Features of a centre's neighbours: offset, normal, distance and point pair feature."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from attentionvote.geometry import native
from attentionvote.model.kernels import kernels
from attentionvote.model.row_threads import in_threads

CHANNELS = 10
TINY = 1e-6  # the exporter deletes additions below 1e-8


def pair_features_reference(
    points: Float[Tensor, "sources 3"],
    normals: Float[Tensor, "sources 3"],
    centers: Float[Tensor, "centers 3"],
    center_normals: Float[Tensor, "centers 3"],
    index: Int[Tensor, "centers neighbors"],
    radius: float,
) -> Float[Tensor, "centers neighbors 10"]:
    """Ten channels of each neighbour, all of order one.

    Offset / radius (3), the neighbour's normal (3), distance / radius, and the cosines of the point pair feature
    (paper section 3.1): between the centre's normal and the offset, the neighbour's normal and the offset, and
    the two normals. The paper's PPF has angles; cosines carry the same information, are cheaper, exist in ONNX,
    and stay finite for a point that is its own neighbour. Offset and normal are kept beside the
    rotation-invariant PPF because the centre votes must turn with the scene.
    """
    # [n, 3] -> [s, h, 3], from the centres [s, 1, 3]
    offset = points[index] - centers[:, None]
    normal = normals[index]
    distance = offset.norm(dim=-1, keepdim=True)
    unit = offset / (distance + TINY)
    # [s, 3] -> [s, h, 3]
    center_normal = center_normals[:, None].expand_as(normal)
    cosines = [
        (a * b).sum(-1, keepdim=True) for a, b in ((center_normal, unit), (normal, unit), (center_normal, normal))
    ]
    return torch.cat([offset / radius, normal, distance / radius, *cosines], dim=-1)


def pair_features(
    points: Float[Tensor, "sources 3"],
    normals: Float[Tensor, "sources 3"],
    centers: Float[Tensor, "centers 3"],
    center_normals: Float[Tensor, "centers 3"],
    index: Int[Tensor, "centers neighbors"],
    radius: float,
) -> Float[Tensor, "centers neighbors 10"]:
    """``pair_features_reference`` by the fastest means at hand; carries no gradient (its inputs are measurements)."""
    library = kernels("network_ops.c", points)
    if library is None:
        return pair_features_reference(points, normals, centers, center_normals, index, radius)
    out = torch.empty(*index.shape, CHANNELS)
    arrays: list[np.ndarray] = [
        t.detach().contiguous().numpy() for t in (points, normals, centers, center_normals, index.long())
    ]
    sizes = index.shape[1], float(radius)

    def work(_: int, *rows: int) -> None:
        native.call(library.pair_features, *arrays, *map(native.long, rows), *sizes, out.numpy())

    in_threads(len(centers), work)
    return out
