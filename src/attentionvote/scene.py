"""A scene: what the sensor saw and where the parts really were."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BACKGROUND = -1


@dataclass(frozen=True, eq=False)
class Scene:
    """A point cloud in the camera frame with the instances in it.

    Args:
        points: ``(P, 3)`` float32 metres, camera frame, random order.
        instance_ids: ``(P,)`` int32, index of the instance a point lies on, ``BACKGROUND`` for none.
        camera_from_part: ``(I, 4, 4)`` float64 poses.
        visible_fraction: ``(I,)`` float64 in [0, 1]: visible share of an instance's own silhouette.
        part_ids: ``(I,)`` int32, index of the part in the model's list of parts.
        normals: ``(P, 3)`` float32 unit vectors towards the camera, or None before they are estimated.

    Raises:
        ValueError: with one sentence, on shapes that disagree, non-finite points or impossible ids.
    """

    points: NDArray[np.float32]
    instance_ids: NDArray[np.int32]
    camera_from_part: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    part_ids: NDArray[np.int32]
    normals: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        p, i = len(self.points), len(self.camera_from_part)
        shapes = {
            "points": (self.points.shape, (p, 3)),
            "instance_ids": (self.instance_ids.shape, (p,)),
            "camera_from_part": (self.camera_from_part.shape, (i, 4, 4)),
            "visible_fraction": (self.visible_fraction.shape, (i,)),
            "part_ids": (self.part_ids.shape, (i,)),
        }
        if self.normals is not None:
            shapes["normals"] = (self.normals.shape, (p, 3))
        for name, (actual, expected) in shapes.items():
            if actual != expected:
                raise ValueError(f"scene {name} must have shape {expected}, got {actual}")
        if not np.isfinite(self.points).all():
            bad = int((~np.isfinite(self.points)).any(axis=1).sum())
            raise ValueError(f"scene points must be finite, got {bad} points with NaN or inf")
        if p and (self.instance_ids.min() < BACKGROUND or self.instance_ids.max() >= i):
            raise ValueError(
                f"scene instance_ids must lie in -1..{i - 1}, got {self.instance_ids.min()}..{self.instance_ids.max()}"
            )
