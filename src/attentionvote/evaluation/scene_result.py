"""What was found in one scene, beside what lies in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Distance(Protocol):
    """A distance between poses, in metres: ``PoseMetric``, ``AverageDistance`` or ``NearestPointDistance``."""

    def distances(self, a: Array, b: Array) -> Array:
        """Distances ``(A, B)`` in metres between poses ``(A, 4, 4)`` and ``(B, 4, 4)``."""
        ...


@dataclass
class SceneResult:
    """The results of a detector in one scene and the ground truth, in one common frame.

    Args:
        poses: results ``(R, 4, 4)``, e.g. ``camera_from_part``, metres; an empty list is no result.
        scores: ``(R,)``, higher is more confident, any scale.
        gt_poses: ground truth ``(I, 4, 4)``, same frame.
        gt_occlusion: ``(I,)``, 1 - visible fraction.

    Raises:
        ValueError: with one sentence, when shapes disagree or a number is not finite.
    """

    poses: Array
    scores: Array
    gt_poses: Array
    gt_occlusion: Array

    def __post_init__(self) -> None:
        self.scores = _numbers("scores", self.scores, (-1,))
        self.gt_occlusion = _numbers("gt_occlusion", self.gt_occlusion, (-1,))
        self.poses = _numbers("poses", self.poses, (len(self.scores), 4, 4))
        self.gt_poses = _numbers("gt_poses", self.gt_poses, (len(self.gt_occlusion), 4, 4))

    def above(self, score: float) -> SceneResult:
        """The scene with only the results of at least this score."""
        kept = self.scores >= score
        return SceneResult(self.poses[kept], self.scores[kept], self.gt_poses, self.gt_occlusion)

    def to_find(self, occlusion_limit: float = 0.5) -> NDArray[np.bool_]:
        """Which ground-truth poses ``(I,)`` must be found: ``-0.1 <= occlusion <= occlusion_limit``."""
        return (self.gt_occlusion >= -0.1) & (self.gt_occlusion <= occlusion_limit)


def _numbers(name: str, values: object, shape: tuple[int, ...]) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 and len(array) == 0:
        array = array.reshape(0, *shape[1:])
    expected = tuple(len(array) if size < 0 and array.ndim else size for size in shape)
    if array.shape != expected:
        raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {int((~np.isfinite(array)).sum())} NaN or inf")
    return array


def distance_tables(scenes: Sequence[SceneResult], distance: Distance) -> list[Array]:
    """Distances ``(R, I)`` in metres between results and ground truth, one table a scene."""
    return [distance.distances(scene.poses, scene.gt_poses) for scene in scenes]
