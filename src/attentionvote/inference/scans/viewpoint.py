"""The VIEWPOINT of a PCD file: where the sensor stood in the frame of the cloud. Points come back to its own frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, inverse, matrix_from_quaternion, transform
from attentionvote.inference.scans.limits import BLOCK_ROWS, Budget
from attentionvote.inference.scans.missing_points import mark_missing

_FARTHEST = 1e6  # in the cloud's unit: a kilometre of millimetres
_NORM_SLACK = 0.01


def viewpoint_pose(words: list[str]) -> NDArray[np.float64] | None:
    """The pose ``(4, 4)`` cloud_from_camera that the words of a VIEWPOINT say; None when the two frames are the same.

    Args:
        words: translation x y z and quaternion w x y z; none: the file has no VIEWPOINT.

    Raises:
        ValueError: with what is wrong, when that is no pose.
    """
    if not words:
        return None
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.zeros(0)
    fits = numbers.shape == (7,) and np.isfinite(numbers).all() and np.abs(numbers).max() <= _FARTHEST
    if not fits or abs(np.linalg.norm(numbers[3:]) - 1) > _NORM_SLACK:
        raise ValueError(
            "its VIEWPOINT must be a pose tx ty tz qw qx qy qz with a quaternion of length 1, "
            f"got {' '.join(words)[:60]!r}: write 0 0 0 1 0 0 0 when the points are in the camera's frame"
        )
    if not numbers[:3].any() and not numbers[4:].any():
        return None
    return transform(matrix_from_quaternion(numbers[3:] / np.linalg.norm(numbers[3:])), numbers[:3])


def in_camera_frame(points: NDArray[np.float32], viewpoint: NDArray[np.float64] | None, budget: Budget) -> None:
    """Bring points ``(P, 3)`` from the cloud's frame into the camera's, in place; missing ones stay NaN.

    Args:
        points: in the cloud's frame and unit.
        viewpoint: ``(4, 4)`` cloud_from_camera; None: nothing is to be done.
        budget: whose clock is looked at.

    Raises:
        ValueError: when the budget is spent.
    """
    if viewpoint is None:
        return
    camera_from_cloud = inverse(viewpoint)
    for start in range(0, len(points), BLOCK_ROWS):
        budget.check_time()
        rows = slice(start, start + BLOCK_ROWS)
        with np.errstate(over="ignore", invalid="ignore"):
            points[rows] = apply(camera_from_cloud, points[rows])
        mark_missing(points[rows])
