"""Whose point a point is, where no image of labels says it: the posed surface that it lies on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.geometry.pose import apply, inverse
from attentionvote.part import Part
from attentionvote.scene import BACKGROUND

_SURFACE_POINTS = 20_000  # of the part: half a percent of D apart, or less
# Of D; twice what a scanner and its calibration miss, less than what lies between two parts that touch.
TOLERANCE = 0.03


class PartSurface:
    """The surface of a part, as points of it.

    Args:
        part: in the frame of the poses.
    """

    def __init__(self, part: Part) -> None:
        self._tree = cKDTree(part.surface_points(_SURFACE_POINTS, np.random.default_rng(0)))
        self._box, self._limit = part.box, TOLERANCE * part.diameter

    def distances(self, points: NDArray[np.floating], camera_from_part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres ``(P,)`` of ``points`` ``(P, 3)`` from the surface at a pose ``(4, 4)``."""
        return np.asarray(self._tree.query(apply(inverse(camera_from_part), points))[0])

    def owners(self, points: NDArray[np.floating], camera_from_part: NDArray[np.float64]) -> NDArray[np.int32]:
        """Row ``(P,)`` of the pose whose surface is the nearest, ``BACKGROUND`` where all are too far.

        Args:
            points: ``(P, 3)`` metres, camera frame.
            camera_from_part: ``(I, 4, 4)``.
        """
        owner = np.full(len(points), BACKGROUND, dtype=np.int32)
        best = np.full(len(points), self._limit)
        low, high = self._box[0] - self._limit, self._box[1] + self._limit
        for row, part_from_camera in enumerate(inverse(camera_from_part)):
            local = apply(part_from_camera, points)
            near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
            distance = self._tree.query(local[near])[0]
            nearer = distance < best[near]
            owner[near[nearer]], best[near[nearer]] = row, distance[nearer]
        return owner
