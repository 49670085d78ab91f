"""Coordinates of any layout as one float32 cloud, in which whatever was not measured is NaN."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import BLOCK_ROWS, Budget

_POINT_BYTES = 12


def cloud_of(axes: Sequence[NDArray[np.floating]], budget: Budget) -> NDArray[np.float32]:
    """A new cloud ``(P, 3)`` of three columns ``(P,)``; missing points are NaN in all three coordinates.

    Args:
        axes: x, y and z, of any floating-point type and stride.
        budget: the cloud's bytes are taken from it.

    Raises:
        ValueError: when the budget is spent.
    """
    count = len(axes[0])
    budget.take(count * _POINT_BYTES)
    cloud = np.empty((count, 3), np.float32)
    for start in range(0, count, BLOCK_ROWS):
        budget.check_time()
        rows = slice(start, start + BLOCK_ROWS)
        with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, thus missing
            for axis, column in enumerate(axes):
                cloud[rows, axis] = column[rows]
        mark_missing(cloud[rows])
    return cloud


def mark_missing(points: NDArray[np.float32]) -> None:
    """Make every missing point of ``(P, 3)`` NaN in all three coordinates, in place.

    Missing is what has a coordinate that is not finite (NaN, or inf as ROS writes it), or lies exactly at the sensor's
    origin, which is how sensors without NaN write it.
    """
    x, y, z = points.T
    missing = ~(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
    missing |= (x == 0) & (y == 0) & (z == 0)
    if missing.any():
        for axis in (x, y, z):  # whole rows at once take twice the time
            axis[missing] = np.nan
