"""Slow, plain numpy versions of the operators in ``sampling``: their oracle, their stand-in without a compiler.

A squared distance that overflows counts as the largest number that float32 has: farther than all others, and never
within a radius.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LARGEST = np.finfo(np.float32).max


def farthest_point_order(points: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """See ``sampling.farthest_point_order``; one pass over all points for every chosen one."""
    order = np.zeros(count, dtype=np.int64)
    squared = np.full(len(points), np.inf, dtype=np.float32)
    for step in range(1, count):
        squared = np.minimum(squared, _squared(points, points[order[step - 1]]))
        order[step] = np.argmax(squared)
    return order


def ball_query(
    points: NDArray[np.float32], centers: NDArray[np.float32], radius: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """See ``sampling.ball_query``; one pass over all points for every centre."""
    neighbors = np.zeros((len(centers), count), dtype=np.int64)
    neighbor_counts = np.zeros(len(centers), dtype=np.int64)
    with np.errstate(over="ignore"):
        limit = min(np.square(np.float32(radius)), np.nextafter(_LARGEST, np.float32(0)))
    for row, center in enumerate(centers):
        inside = np.flatnonzero(_squared(points, center) <= limit)[:count]
        if len(inside):
            neighbors[row] = inside[0]
            neighbors[row, : len(inside)] = inside
        neighbor_counts[row] = len(inside)
    return neighbors, neighbor_counts


def three_nearest(
    sources: NDArray[np.float32], targets: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """See ``sampling.three_nearest``; sorts all sources for every target."""
    neighbors = np.zeros((len(targets), 3), dtype=np.int64)
    distances = np.zeros((len(targets), 3), dtype=np.float32)
    for row, target in enumerate(targets):
        squared = _squared(sources, target)
        nearest = np.argsort(squared, kind="stable")[:3]
        nearest = np.concatenate([nearest, np.repeat(nearest[-1], 3 - len(nearest))])
        neighbors[row], distances[row] = nearest, np.sqrt(squared[nearest])
    return neighbors, distances


def _squared(points: NDArray[np.float32], center: NDArray[np.float32]) -> NDArray[np.float32]:
    # The same order of float32 operations as the C code, so that ties and borders fall alike.
    with np.errstate(over="ignore"):
        dx, dy, dz = (points[:, axis] - center[axis] for axis in range(3))
        return np.minimum(dx * dx + dy * dy + dz * dz, _LARGEST)
