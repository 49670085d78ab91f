"""The network's input from a depth image: back-projection, normals, sampling. One code for training and cell.

Training on normals of another estimator than the cell's would be training on another sensor (14 degrees apart
on average between ray-cast and PCA normals), so both sides call ``estimate_normals``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import native

NORMAL_NEIGHBORS = 30
_ROWS = 128  # of a depth image at a time


def back_project(
    depth: NDArray[np.floating], fx: float, fy: float, cx: float, cy: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Points ``(P, 3)`` in the camera frame of a depth image and the flat pixel index ``(P,)`` of each.

    Args:
        depth: ``(H, W)`` metres along the optical axis; 0 and non-finite values are missing.
        fx, fy, cx, cy: pinhole intrinsics in pixels, pixel centres at whole numbers.

    Raises:
        ValueError: when the image is not two-dimensional, has negative depth, or the focal length is not positive.
    """
    if depth.ndim != 2:
        raise ValueError(f"depth must be an image (H, W), got shape {depth.shape}")
    if not (fx > 0 and fy > 0):
        raise ValueError(f"focal lengths must be positive pixels, got fx {fx} and fy {fy}")
    parts = [_back_projected(depth[top : top + _ROWS], top, fx, fy, cx, cy) for top in range(0, len(depth), _ROWS)]
    points = [points for points, _ in parts] or [np.zeros((0, 3), np.float32)]
    pixels = [pixels for _, pixels in parts] or [np.zeros(0, np.int64)]
    return np.concatenate(points), np.concatenate(pixels)


def _back_projected(
    rows: NDArray[np.floating], top: int, fx: float, fy: float, cx: float, cy: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Some rows of an image, so that its numbers in double precision are never there at once; ``top`` is the first."""
    valid = np.isfinite(rows)
    if (rows[valid] < 0).any():
        raise ValueError(f"depth must not be negative, got {float(rows[valid].min()):.4g} m")
    pixels = np.flatnonzero(valid & (rows > 0))
    z = rows.reshape(-1)[pixels].astype(np.float64)
    v, u = np.divmod(pixels, rows.shape[1])
    points = np.empty((len(pixels), 3), np.float32)
    points[:, 0], points[:, 1], points[:, 2] = (u - cx) * z / fx, (v + top - cy) * z / fy, z
    return points, pixels + top * rows.shape[1]


def estimate_normals(
    points: NDArray[np.float32],
    query: NDArray[np.float32] | None = None,
    neighbors: int = NORMAL_NEIGHBORS,
    make: bool = True,
) -> NDArray[np.float32]:
    """Unit normals ``(Q, 3)`` by principal component analysis, turned towards the camera at the origin.

    The direction of least variance of the ``neighbors`` nearest points (the point itself included), as Open3D
    does (paper section 3.5). The neighbours come from the whole cloud even when only a sample of it is asked
    for: a denser cloud gives better normals at the same cost per asked point.

    Args:
        points: ``(P, 3)`` metres, camera frame, the densest cloud at hand.
        query: ``(Q, 3)`` where normals are wanted; all points when None.
        neighbors: size of the neighbourhood; all points when there are fewer.
        make: whether the C code may be compiled now. A cell never does that: it has what its image brings, or takes the
            reference.

    Raises:
        ValueError: when there are fewer than three points or any is not finite.
    """
    asked = points if query is None else query
    for name, value in (("points", points), ("query", asked)):
        if value.ndim != 2 or value.shape[1] != 3:
            raise ValueError(f"{name} must have shape (P, 3), got {value.shape}")
        if not np.isfinite(value).all():
            raise ValueError(
                f"{name} must be finite, got {int((~np.isfinite(value)).any(axis=1).sum())} with NaN or inf"
            )
    if len(points) < 3:
        raise ValueError(f"normals need at least 3 points, got {len(points)}")
    libraries = [native.load("attentionvote.geometry", file, make=make) for file in ("pointops.c", "normals.c")]
    nearest = min(neighbors, len(points))
    if libraries[0] is None or libraries[1] is None:
        return estimate_normals_reference(points, asked, nearest)
    order, turn = (np.empty(len(a), dtype=np.int32) for a in (points, asked))
    clouds = [np.ascontiguousarray(a, dtype=np.float32) for a in (points, asked)]
    normals = np.empty_like(clouds[1])
    sort = libraries[0].morton_order
    served = all(native.call(sort, c, len(c), ranks) for c, ranks in zip(clouds, (order, turn), strict=True))
    arguments = clouds[0], order, len(points), clouds[1], turn, len(asked), nearest, normals
    if served and native.call(libraries[1].normals, *arguments):
        return normals
    return estimate_normals_reference(points, asked, nearest)


def estimate_normals_reference(
    points: NDArray[np.float32], asked: NDArray[np.float32], neighbors: int
) -> NDArray[np.float32]:
    """``estimate_normals`` of checked arguments with scipy's kd-tree and LAPACK; ``neighbors`` at most all points."""
    # Where the C code is, nothing else needs scipy: a cell's processes start sooner and are smaller without it.
    from scipy.spatial import cKDTree

    tree = cKDTree(points, balanced_tree=False, compact_nodes=False, leafsize=32)
    index = tree.query(asked, k=range(1, neighbors + 1))[1]
    near = points.astype(np.float64)[index]
    near -= near.mean(axis=1, keepdims=True)
    covariance = np.einsum("qki,qkj->qij", near, near, optimize=True)
    normals = np.linalg.eigh(covariance)[1][:, :, 0]
    away = np.einsum("qi,qi->q", normals, asked) > 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)


def sample_indices(available: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` random indices below ``available``: without repetition, or with it when there are too few.

    Raises:
        ValueError: when there is nothing to choose from.
    """
    if available < 1:
        raise ValueError("cannot sample from an empty cloud: 0 points available")
    if available >= count:
        return rng.permutation(available)[:count]
    return np.concatenate([rng.permutation(available), rng.integers(0, available, count - available)])
