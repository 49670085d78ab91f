"""Results of one scene, beside its ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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
        part_ids: ``(R,)`` which part of a set each result is called; left out, all are the first.
        gt_part_ids: ``(I,)`` which part each instance is.

    Raises:
        ValueError: with one sentence, when shapes disagree or a number is not finite.
    """

    poses: Array
    scores: Array
    gt_poses: Array
    gt_occlusion: Array
    part_ids: NDArray[np.integer] = field(default=None)  # type: ignore[arg-type]  # None only until it is filled in
    gt_part_ids: NDArray[np.integer] = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        self.scores = _numbers("scores", self.scores, (-1,))
        self.gt_occlusion = _numbers("gt_occlusion", self.gt_occlusion, (-1,))
        self.poses = _numbers("poses", self.poses, (len(self.scores), 4, 4))
        self.gt_poses = _numbers("gt_poses", self.gt_poses, (len(self.gt_occlusion), 4, 4))
        self.part_ids = _ids("part_ids", self.part_ids, len(self.scores))
        self.gt_part_ids = _ids("gt_part_ids", self.gt_part_ids, len(self.gt_occlusion))

    def above(self, score: float) -> SceneResult:
        """The scene with only the results of at least this score."""
        return self._only(self.scores >= score, np.ones(len(self.gt_poses), dtype=bool))

    def of_part(self, part_id: int) -> SceneResult:
        """The scene with only the results and the truth of one part."""
        return self._only(self.part_ids == part_id, self.gt_part_ids == part_id)

    def _only(self, results: NDArray[np.bool_], true: NDArray[np.bool_]) -> SceneResult:
        return SceneResult(
            self.poses[results], self.scores[results], self.gt_poses[true], self.gt_occlusion[true],
            self.part_ids[results], self.gt_part_ids[true],
        )  # fmt: skip

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


def _ids(name: str, values: object, count: int) -> NDArray[np.int64]:
    ids = np.zeros(count, dtype=np.int64) if values is None else np.asarray(values).astype(np.int64)
    if ids.shape != (count,):
        raise ValueError(f"{name} must have shape {(count,)}, got {ids.shape}")
    return ids


def distance_tables(scenes: Sequence[SceneResult], distance: Distance) -> list[Array]:
    """Distances ``(R, I)`` in metres between results and ground truth, one table a scene."""
    return [distance.distances(scene.poses, scene.gt_poses) for scene in scenes]
