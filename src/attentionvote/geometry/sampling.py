"""Points and neighbours that the network sees: farthest-point order, ball query, nearest three.

Each operator has a C implementation (``pointops.c``, compiled once per machine with the system's C compiler,
no torch headers, no CUDA) and a slow numpy reference in ``sampling_reference``, which is its oracle in the
tests and takes its place where no compiler is found, or where points lie 1e18 m away, which a square in float32 may not
hold. Both return the same indices.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import native, sampling_reference


def farthest_point_order(points: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Indices ``(count,)`` of points so that each is the farthest from all before it; starts at index 0.

    Exact, ties to the lowest index, so the first m of the order are what a shorter call would return: every
    level of the network is a prefix of one order.

    Args:
        points: ``(P, 3)`` metres.
        count: number of points to choose, at most P.

    Raises:
        ValueError: when ``points`` is not ``(P, 3)`` and finite or ``count`` is not in 1..P.
    """
    xyz = _checked("points", points)
    if not 1 <= count <= len(xyz):
        raise ValueError(f"count must lie in 1..{len(xyz)} (the number of points), got {count}")
    library = native.load("attentionvote.geometry", "pointops.c")
    order = np.empty(count, dtype=np.int32)
    if library is not None and native.call(library.farthest_point_order, xyz, len(xyz), count, order):
        return order.astype(np.int64)
    return sampling_reference.farthest_point_order(xyz, count)


def ball_query(
    points: NDArray[np.float32], centers: NDArray[np.float32], radius: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first ``count`` points in index order within ``radius`` of each centre (PointNet++'s meaning).

    Because the order of a sample's points is random this is a uniform sample of the ball; the nearest
    ``count`` points would be another network.

    Args:
        points: ``(P, 3)`` metres.
        centers: ``(C, 3)`` metres.
        radius: metres; a point at exactly this distance is inside.
        count: neighbours per centre.

    Returns:
        Indices ``(C, count)``, short balls padded with their first index (0 when empty), and the number of
        real neighbours ``(C,)``.

    Raises:
        ValueError: on shapes, non-finite points, or a radius or count that is not positive.
    """
    xyz, middle = _checked("points", points), _checked("centers", centers, empty=True)
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be a positive number of metres, got {radius}")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    library = native.load("attentionvote.geometry", "pointops.c")
    neighbors = np.empty((len(middle), count), dtype=np.int32)
    neighbor_counts = np.empty(len(middle), dtype=np.int32)
    arguments = xyz, len(xyz), middle, len(middle), float(radius), count, neighbors, neighbor_counts
    if library is not None and native.call(library.ball_query, *arguments):
        return neighbors.astype(np.int64), neighbor_counts.astype(np.int64)
    return sampling_reference.ball_query(xyz, middle, radius, count)


def level_neighbors(
    points: NDArray[np.float32], centers: Sequence[int], neighbors: Sequence[int], radii: Sequence[float]
) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """The farthest-point order ``(S1,)`` of a sample, and the neighbours ``(S_l, k_l)`` of every level's centres.

    A level's centres are the first S_l of the order. Its neighbours are indices into the centres of the level below,
    the first level's into the points.

    Args:
        points: ``(N, 3)`` metres in random order, at least ``centers[0]``.
        centers, neighbors, radii: S_l, k_l and metres by level.
    """
    order = farthest_point_order(points, centers[0])
    ordered, below, level_indices = points[order], points, []
    for size, count, radius in zip(centers, neighbors, radii, strict=True):
        level_indices.append(ball_query(below, ordered[:size], radius, count)[0])
        below = ordered[:size]
    return order, level_indices


def three_nearest(
    sources: NDArray[np.float32], targets: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The three nearest sources of every target, nearest first, and their distances.

    Args:
        sources: ``(S, 3)`` metres; with fewer than three the last one is repeated.
        targets: ``(T, 3)`` metres.

    Returns:
        Indices ``(T, 3)`` and distances ``(T, 3)`` in metres.
    """
    xyz, goal = _checked("sources", sources), _checked("targets", targets, empty=True)
    library = native.load("attentionvote.geometry", "pointops.c")
    neighbors = np.empty((len(goal), 3), dtype=np.int32)
    squared = np.empty((len(goal), 3), dtype=np.float32)
    if library is not None and native.call(library.three_nearest, xyz, len(xyz), goal, len(goal), neighbors, squared):
        return neighbors.astype(np.int64), np.sqrt(squared)
    return sampling_reference.three_nearest(xyz, goal)


def _checked(name: str, points: NDArray, empty: bool = False) -> NDArray[np.float32]:
    xyz = np.ascontiguousarray(points, dtype=np.float32)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or (len(xyz) == 0 and not empty):
        raise ValueError(f"{name} must have shape (P, 3) with P >= 1, got {xyz.shape}")
    if not np.isfinite(xyz).all():
        raise ValueError(f"{name} must be finite, got {int((~np.isfinite(xyz)).any(axis=1).sum())} with NaN or inf")
    return xyz
