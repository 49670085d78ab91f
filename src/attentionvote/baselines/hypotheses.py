"""Many poses, each with votes, to few: merging, suppression, and how well a pose explains the cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.geometry.pose import apply
from attentionvote.geometry.symmetry import Symmetry

Array = NDArray[np.float64]


def merged(
    poses: Array, votes: Array, center: Array, symmetry: Symmetry, distance: float, angle: float
) -> tuple[Array, Array]:
    """Clusters of similar poses, as Drost et al. (CVPR 2010, section 3.4) build them: most votes first.

    The pose with most votes takes those near it along and adds their votes to its own; then the next that is left.

    Args:
        poses: ``(R, 4, 4)`` camera from part, metres.
        votes: ``(R,)``.
        center: ``(3,)`` of the part, part frame: what ``distance`` is measured at.
        symmetry: of the part; the angle between two poses is the least over it.
        distance, angle: metres and radians within which two poses are similar.

    Returns:
        Poses ``(C, 4, 4)``, each its cluster's best, and votes ``(C,)`` of the clusters, most first.
    """
    centers = apply(poses, center[None])[:, 0]
    free = np.ones(len(poses), dtype=bool)
    best, totals = [], []
    for i in np.argsort(-votes, kind="stable"):
        if not free[i]:
            continue
        near = np.flatnonzero(free & (np.linalg.norm(centers - centers[i], axis=1) <= distance))
        near = near[symmetry.angle(poses[near, :3, :3], poses[i, :3, :3]) <= angle]
        free[near] = False
        best.append(i)
        totals.append(votes[near].sum())
    order = np.argsort(-np.asarray(totals, dtype=np.float64), kind="stable")
    return poses[np.asarray(best, dtype=np.int64)[order]], np.asarray(totals, dtype=np.float64)[order]


def apart(poses: Array, scores: Array, center: Array, distance: float) -> NDArray[np.int64]:
    """Indices ``(K,)`` of the poses, best score first, whose centre is farther than ``distance`` from every better one.

    Two parts cannot be in one place, however they are turned.
    """
    centers = apply(poses, center[None])[:, 0]
    separate: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        if not separate or np.linalg.norm(centers[separate] - centers[i], axis=1).min() > distance:
            separate.append(int(i))
    return np.asarray(separate, dtype=np.int64)


def fits(poses: Array, model: NDArray[np.float32], cloud: cKDTree, distance: float) -> Array:
    """Share ``(R,)`` of the model's points that face the camera and have a point of the cloud within ``distance``.

    Args:
        poses: ``(R, 4, 4)``.
        model: ``(Q, 6)`` points and normals, part frame.
        cloud: tree of the measured points, camera frame.
        distance: metres.
    """
    shares = np.zeros(len(poses))
    for i, pose in enumerate(poses):
        seen = placed(model, pose)[:, :3]
        if len(seen):
            shares[i] = np.isfinite(cloud.query(seen, distance_upper_bound=distance)[0]).mean()
    return shares


def placed(model: NDArray[np.float32], pose: Array) -> NDArray[np.float32]:
    """The model's points and normals ``(S, 6)`` in the camera frame, those that face the camera only."""
    points = apply(pose, model[:, :3])
    normals = model[:, 3:] @ pose[:3, :3].T
    facing = np.einsum("qi,qi->q", points, normals) < 0
    return np.concatenate([points, normals], axis=1)[facing].astype(np.float32)
