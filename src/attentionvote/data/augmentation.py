"""Random motion of training samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import rotation_about
from attentionvote.section import check
from attentionvote.setting import Setting


@dataclass(frozen=True)
class Augmentation:
    """Random motion of a training sample about its centroid.

    Raises:
        SettingError: when a setting is out of its range.
    """

    roll: Annotated[bool, Setting("Whether a sample is turned by any angle about the optical axis.")] = True
    tilt: Annotated[
        float,
        Setting("Standard deviation of a turn about a random axis in the image plane, radians.", low=0, high=3.15),
    ] = 0.15
    jitter_mm: Annotated[
        float,
        Setting("Noise after the normals, which stay as they were; the sensor's is before them.", low=0, high=100),
    ] = 0.0

    def __post_init__(self) -> None:
        check(self)

    def apply(
        self,
        points: NDArray[np.float32],
        normals: NDArray[np.float32],
        poses: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
        """Moved points ``(N, 3)``, normals ``(N, 3)`` and poses ``(I, 4, 4)``."""
        turn = rotation_about([0, 0, 1], rng.uniform(0, 2 * np.pi) if self.roll else 0.0)
        direction = rng.uniform(0, 2 * np.pi)
        turn = rotation_about([np.cos(direction), np.sin(direction), 0], rng.normal(0, self.tilt)) @ turn
        middle = points.mean(axis=0, dtype=np.float64)
        turn32 = turn.T.astype(np.float32)
        moved = (points - middle.astype(np.float32)) @ turn32 + middle.astype(np.float32)
        if self.jitter_mm:
            moved = moved + rng.normal(0, self.jitter_mm / 1000, moved.shape).astype(np.float32)
        turned_poses = poses.copy()
        turned_poses[:, :3, :3] = turn @ poses[:, :3, :3]
        turned_poses[:, :3, 3] = (poses[:, :3, 3] - middle) @ turn.T + middle
        return moved, normals @ turn32, turned_poses
