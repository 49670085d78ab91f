"""From a sensor's cloud to the graph's inputs, as training did it: crop, random subset, normals of the dense cloud.

Normals come from ``geometry.pointcloud.estimate_normals``, which made the training's clouds too. The random choices
have a fixed seed, so the same cloud gives the same inputs, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry import native
from attentionvote.geometry.pointcloud import estimate_normals, sample_indices
from attentionvote.geometry.pose import apply, inverse
from attentionvote.geometry.sampling import level_neighbors
from attentionvote.inference.blind_sensor import check_sight
from attentionvote.inference.errors import InputError
from attentionvote.inference.measured_points import MeasuredPoints
from attentionvote.inference.scale_check import check_scene, check_unit
from attentionvote.inference.scans.depth_files import CameraIntrinsics

SEED = 0
_FARTHEST = 20


class TooFewPoints(Exception):
    """Nothing to work on: an answer about the bin, not an error of the caller.

    Attributes:
        used: points left.
    """

    def __init__(self, message: str, used: int) -> None:
        super().__init__(message)
        self.used = used


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
                value = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise InputError(f"bin {name} must be {shape} numbers, got something else") from error
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


class Prepared(NamedTuple):
    """The graph's inputs and where they come from.

    Attributes:
        points, normals: ``(1, N, 3)`` float32, camera frame.
        used: points left without missing ones and after the crop.
        warnings: sentences about an unusual cloud.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    used: int
    warnings: tuple[str, ...]


def find_neighbors(points: NDArray[np.float32], layout: Mapping[str, Any] | None) -> list[NDArray[np.int64]]:
    """What the graph need not find itself: the C code does in a tenth of the time; nothing where there is none.

    Args:
        points: ``(1, N, 3)`` of the graph's input.
        layout: see ``Session``.
    """
    if layout is None or native.load("attentionvote.geometry", "pointops.c", make=False) is None:
        return []
    order, neighbors = level_neighbors(points[0], **layout)
    return [order, *neighbors]


def fewest_points(card: ModelCard) -> int:
    """With fewer points than neighbours in a normal's estimation every normal comes from the same, whole cloud."""
    return max(3, card.normal_neighbors)


def prepare(
    scan: MeasuredPoints,
    card: ModelCard,
    crop: Crop | None = None,
    camera: CameraIntrinsics | None = None,
    seed: int = SEED,
    between: Callable[[], None] = lambda: None,
) -> Prepared:
    """The graph's inputs from a cloud.

    Args:
        scan: its measured points.
        card: of the model.
        crop: the inside of the bin; None: the cloud holds parts only.
        camera: that measured it, where it is known: how much of the bin it should have measured.
        seed: of the random choices.
        between: called before each step that takes long; what it raises ends the preparation.

    Raises:
        InputError: when the cloud is not in metres in the camera frame.
        BlindSensor: when much less of the bin was measured than is to be expected.
        TooFewPoints: when fewer points are left than normals need.
    """
    cloud, seen, least = scan.points, len(scan.points), fewest_points(card)
    if crop is not None or seen < least:  # otherwise check_scene says the same, and more
        check_unit(cloud, card)
    if crop is not None:
        between()
        inside = crop.inside(cloud)
        check_sight(cloud, int(np.count_nonzero(inside)), (crop.camera_from_bin, crop.size), card, camera)
        cloud = cloud[inside]
    if len(cloud) < least:
        where = f" are left in the bin of {seen} measured" if crop is not None else " were measured"
        raise TooFewPoints(f"{len(cloud)} points{where}, at least {least} are needed to look for parts", len(cloud))
    warnings = (*scan.warnings, *check_scene(cloud, card))
    rng = np.random.default_rng(seed)
    dense = cloud if len(cloud) <= card.density else cloud[sample_indices(len(cloud), card.density, rng)]
    chosen = np.ascontiguousarray(dense[sample_indices(len(dense), card.points, rng)])
    between()
    normals = estimate_normals(dense, chosen, card.normal_neighbors, make=False)
    return Prepared(chosen[None], normals[None], len(cloud), warnings)
