"""Average distances of model points: ADD (Eq. 13 of the paper) and ADD-S (Hinterstoisser et al. 2012).

A part with symmetries has several equally right poses, so ADD takes the minimum over them. Both
classes work pair by pair in blocks of bounded memory, and skip pairs that are certainly farther than
``limit``: of these they give a lower bound that also exceeds ``limit``, which no matching can tell apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from attentionvote.evaluation.scene_result import Array
from attentionvote.geometry.pose import rotation_about
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part

MODEL_POINTS = 1000
BLOCK_VALUES = 4_000_000  # numbers in one intermediate array, 32 MB


def model_points(part: Part, count: int = MODEL_POINTS) -> Array:
    """``(count, 3)`` points on the surface: the model M of Eq. 13, the same at every call (seed 0)."""
    return part.surface_points(count, np.random.default_rng(0))


@dataclass(frozen=True, eq=False)
class AverageDistance:
    """ADD: mean distance of model points between two poses, least over the symmetries, metres.

    Finite groups are enumerated. For a body of revolution the turn that minimises the *squared* distances
    is taken, in closed form (atan2); on a round surface the true minimum is less than 1 % lower.

    Args:
        points: model ``(P, 3)``, part frame, metres.
        symmetry: proper symmetry of the part; ``Symmetry()`` gives Eq. 13 literally.
        limit: metres; pairs certainly farther get a lower bound above it, see the module.
    """

    points: Array
    symmetry: Symmetry
    limit: float = np.inf

    @classmethod
    def of(cls, part: Part, limit: float = np.inf) -> AverageDistance:
        """ADD of a part with ``MODEL_POINTS`` points on its surface."""
        return cls(model_points(part), part.symmetry, limit)

    def distances(self, a: ArrayLike, b: ArrayLike) -> Array:
        """ADD ``(A, B)`` in metres between poses ``(A, 4, 4)`` and ``(B, 4, 4)``."""
        a, b = _poses(a), _poses(b)
        turns = self.symmetry.rotations()
        centroid = self.points.mean(0)
        # The mean of lengths is at least the length of the mean: the distance of the centroids.
        b_centroids = b[:, None, :3, :3] @ turns @ centroid + b[:, None, :3, 3]
        if self.symmetry.is_revolution:
            # Turning moves a centroid off the axis; the part of it on the axis stays where it is.
            axis = np.asarray(self.symmetry.axis)
            slack = 2 * float(np.linalg.norm(centroid - axis * (axis @ centroid)))
        else:
            slack = 0.0
        a_centroids = a[:, :3, :3] @ centroid + a[:, :3, 3]
        gap = np.linalg.norm(a_centroids[:, None, None] - b_centroids, axis=-1) - slack
        bound = gap.min(-1, initial=np.inf).clip(0.0)
        table = bound.copy()
        rows, columns = np.nonzero(bound <= self.limit)
        block = max(1, BLOCK_VALUES // (3 * len(self.points)))
        for start in range(0, len(rows), block):
            i, j = rows[start : start + block], columns[start : start + block]
            best = np.full(len(i), np.inf)
            for turn in turns:
                best = np.minimum(best, self._paired(a[i], b[j], turn))
            table[i, j] = best
        return table

    def _paired(self, a: Array, b: Array, turn: Array) -> Array:
        """ADD ``(P,)`` of paired poses with the symmetry ``turn`` applied to ``b``."""
        r_a, r_b = a[:, :3, :3], b[:, :3, :3] @ turn
        offset = a[:, :3, 3] - b[:, :3, 3]
        if self.symmetry.is_revolution:
            r_b = r_b @ self._best_turn(r_a, r_b, offset)
        difference = self.points @ np.swapaxes(r_a - r_b, -1, -2) + offset[:, None]
        return np.linalg.norm(difference, axis=-1).mean(-1)

    def _best_turn(self, r_a: Array, r_b: Array, offset: Array) -> Array:
        """Turns ``(P, 3, 3)`` about the axis that minimise the mean squared distance of the points."""
        second = self.points.T @ self.points / len(self.points)
        back = np.swapaxes(r_b, -1, -2)
        # Maximise trace(turn^T m): only the part of m perpendicular to the axis depends on the angle.
        m = back @ r_a @ second + (back @ offset[..., None]) * self.points.mean(0)
        frame = self.symmetry.frame()
        m = frame.T @ m @ frame
        angle = np.arctan2(m[:, 1, 0] - m[:, 0, 1], m[:, 0, 0] + m[:, 1, 1])
        return rotation_about(self.symmetry.axis, angle)


@dataclass(frozen=True, eq=False)
class NearestPointDistance:
    """ADD-S: mean distance of the points at one pose to the nearest point at the other, metres.

    Needs no symmetry, and is kinder than ADD: shapes that nearly coincide count as right.

    Args:
        points: model ``(P, 3)``, part frame, metres.
        limit: metres; pairs certainly farther get a lower bound above it, see the module.
    """

    points: Array
    limit: float = np.inf

    @classmethod
    def of(cls, part: Part, limit: float = np.inf) -> NearestPointDistance:
        """ADD-S of a part with ``MODEL_POINTS`` points on its surface."""
        return cls(model_points(part), limit)

    def distances(self, a: ArrayLike, b: ArrayLike) -> Array:
        """ADD-S ``(A, B)`` in metres: mean over the points at ``b`` of the distance to the points at ``a``."""
        a, b = _poses(a), _poses(b)
        centroid = self.points.mean(0)
        radius = float(np.linalg.norm(self.points - centroid, axis=-1).max())
        centroids_a, centroids_b = (p[:, :3, :3] @ centroid + p[:, :3, 3] for p in (a, b))
        # Every point at a lies in a ball about its centroid; distance to a ball is convex.
        gap = np.linalg.norm(centroids_a[:, None] - centroids_b, axis=-1) - radius
        table = gap.clip(0.0)
        tree, low, high = cKDTree(self.points), self.points.min(0), self.points.max(0)
        for i in range(len(a)):
            near = np.flatnonzero(table[i] <= self.limit)
            block = max(1, BLOCK_VALUES // (3 * len(self.points)))
            for start in range(0, len(near), block):
                j = near[start : start + block]
                scene = self.points @ np.swapaxes(b[j, :3, :3], -1, -2) + b[j, None, :3, 3]
                in_part = (scene - a[i, :3, 3]) @ a[i, :3, :3]
                # No point of the model lies outside its box, and that distance needs no search.
                outside = np.maximum(np.maximum(low - in_part, in_part - high), 0.0)
                bound = np.linalg.norm(outside, axis=-1).mean(-1)
                table[i, j] = np.maximum(table[i, j], bound)
                j, in_part = j[bound <= self.limit], in_part[bound <= self.limit]
                table[i, j] = tree.query(in_part.reshape(-1, 3))[0].reshape(len(j), len(self.points)).mean(-1)
        return table


def _poses(poses: ArrayLike) -> Array:
    return np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
