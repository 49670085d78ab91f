"""The bin's inside, which scans are cropped to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, inverse
from attentionvote.inference.errors import InputError

_FARTHEST = 20


@dataclass(frozen=True, eq=False)
class Crop:
    """The inside of the bin, where parts are looked for.

    Args:
        camera_from_bin: ``(4, 4)``; bin frame: middle of the floor, z up.
        size: ``(3,)`` inner length, width and height, metres.
        margin: metres kept away from floor and walls, so that neither is taken for a part.

    Raises:
        InputError: when the pose is not rigid or a length is impossible.
    """

    camera_from_bin: NDArray[np.float64]
    size: NDArray[np.float64]
    margin: float = 0.002

    def __post_init__(self) -> None:
        for name, shape in (("camera_from_bin", (4, 4)), ("size", (3,))):
            try:
                value = np.asarray(getattr(self, name))
            except ValueError as error:  # rows of several lengths
                raise InputError(f"bin {name} must be {shape} numbers, got something else") from error
            if value.dtype.kind not in "iuf":  # texts, or whole numbers beyond all size
                raise InputError(f"bin {name} must be {shape} numbers, got something else")
            value = value.astype(np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"bin {name} must be {shape} finite numbers, got shape {value.shape}")
            object.__setattr__(self, name, value)
        pose, size = self.camera_from_bin, self.size
        turn = pose[:3, :3]
        rigid = np.abs(turn.T @ turn - np.eye(3)).max() < 1e-3 and np.linalg.det(turn) > 0
        if not rigid or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-9:
            raise InputError(
                "bin camera_from_bin must be a rigid transform (a rotation, a translation, last row 0 0 0 1), "
                "got another matrix: is it transposed, scaled or mirrored?"
            )
        if np.abs(pose[:3, 3]).max() > _FARTHEST:
            raise InputError(
                f"bin camera_from_bin must be in metres, at most {_FARTHEST} from the camera, "
                f"got the translation {pose[:3, 3].tolist()}: are these millimetres? divide by 1000"
            )
        if not (size > 0).all() or size.max() > _FARTHEST:
            raise InputError(
                f"bin size must be three positive lengths in metres, at most {_FARTHEST}, "
                f"got {size.tolist()}: are these millimetres? divide by 1000"
            )
        if isinstance(self.margin, bool) or not isinstance(self.margin, (int, float)):
            raise InputError(f"bin margin must be a number of metres, got {self.margin!r}")
        if not 0 <= self.margin < size.min() / 2:
            raise InputError(
                f"bin margin must be metres from 0 to less than half the bin's smallest side ({size.min() / 2:g}), "
                f"got {self.margin}"
            )
        camera_height = float(inverse(pose)[2, 3])
        if camera_height <= size[2]:
            raise InputError(
                f"bin camera_from_bin must have the camera above the opening ({size[2]:g} m over the floor, z up), "
                f"got it at {camera_height:.4g} m: is the bin's frame upside down, or is this bin_from_camera? "
                "turn it, or invert the matrix"
            )

    def inside(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which of the points ``(P, 3)`` lie in the bin; the bin is open to above by its height."""
        local = apply(inverse(self.camera_from_bin), points)
        half = self.size[:2] / 2 - self.margin
        level = (local[:, 2] >= self.margin) & (local[:, 2] <= self.size[2])
        return level & (np.abs(local[:, :2]) <= half).all(axis=1)
