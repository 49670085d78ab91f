"""Clouds as the baselines take them: a part's surface, a measured cloud checked, both thinned; and what is answered."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.part import Part, uniform_points

Array = NDArray[np.float64]


class Detections(NamedTuple):
    """Poses ``(R, 4, 4)`` camera from part, metres, and scores ``(R,)``, best first."""

    camera_from_part: Array
    scores: Array


def surface(part: Part, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Points uniform on the surface and outward normals ``(count, 6)``, part frame, metres."""
    points, faces = uniform_points(part.vertices[part.faces], count, rng)
    a, b, c = (part.vertices[part.faces[faces, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    return np.concatenate([points, cross / np.linalg.norm(cross, axis=1, keepdims=True)], axis=1).astype(np.float32)


def checked(points: NDArray[np.floating], normals: NDArray[np.floating] | None, method: str) -> NDArray[np.float32]:
    """Points and unit normals side by side ``(P, 6)``.

    Args:
        points, normals: ``(P, 3)`` each, camera frame, metres.
        method: plural, whose name the refusal of missing normals begins with.

    Raises:
        ValueError: when normals are missing, shapes disagree or a number is not finite.
    """
    if normals is None:
        raise ValueError(
            f"{method} need a normal at every point, got none: estimate them with geometry.pointcloud.estimate_normals"
        )
    points, normals = np.asarray(points), np.asarray(normals)
    if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
        raise ValueError(f"points and normals must both have shape (P, 3), got {points.shape} and {normals.shape}")
    cloud = np.concatenate([points, normals], axis=1).astype(np.float32)
    if not np.isfinite(cloud).all():
        bad = int((~np.isfinite(cloud)).any(axis=1).sum())
        raise ValueError(f"points and normals must be finite, got {bad} points with NaN or inf")
    length = np.linalg.norm(cloud[:, 3:], axis=1)
    if len(cloud) and not np.abs(length - 1).max() < 0.1:
        raise ValueError(f"normals must be unit vectors, got lengths {length.min():.3g}..{length.max():.3g}")
    return cloud


def thinned(cloud: NDArray[np.float32], voxel: float) -> NDArray[np.float32]:
    """One point a voxel ``(Q, 6)`` of a cloud ``(P, 6)`` of points and unit normals: their means.

    The two sides of a thin wall stay two points: the direction that a normal has most of belongs to the cell.
    """
    cell = np.floor(cloud[:, :3].astype(np.float64) / voxel).astype(np.int64)
    cell -= cell.min(axis=0)
    normals = cloud[:, 3:]
    main = np.abs(normals).argmax(axis=1)
    side = 2 * main + (np.take_along_axis(normals, main[:, None], axis=1)[:, 0] > 0)
    _, inverse, count = np.unique(np.c_[cell, side], axis=0, return_inverse=True, return_counts=True)
    # bincount adds in double precision and in the order of the points: the same cloud, the same bits.
    mean = np.stack([np.bincount(inverse, weights=cloud[:, i]) for i in range(6)], axis=1) / count[:, None]
    mean[:, 3:] /= np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    return mean.astype(np.float32)
