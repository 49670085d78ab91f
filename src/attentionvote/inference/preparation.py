"""From a sensor's cloud to the graph's inputs, as training did it: crop, random subset, normals of the dense cloud.

Normals come from ``geometry.pointcloud.estimate_normals``, which made the training's clouds too. The random choices
have a fixed seed, so the same cloud gives the same inputs, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry import native
from attentionvote.geometry.pointcloud import estimate_normals, sample_indices
from attentionvote.geometry.sampling import level_neighbors
from attentionvote.inference.blind_sensor import check_sight
from attentionvote.inference.crop import Crop
from attentionvote.inference.measured_points import MeasuredPoints
from attentionvote.inference.scale_check import check_scene, check_unit
from attentionvote.inference.scans.depth_files import CameraIntrinsics

SEED = 0


class TooFewPoints(Exception):
    """Nothing to work on: an answer about the bin, not an error of the caller.

    Attributes:
        used: points left.
    """

    def __init__(self, message: str, used: int) -> None:
        super().__init__(message)
        self.used = used


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
    warnings = check_scene(cloud, card)
    rng = np.random.default_rng(seed)
    dense = cloud if len(cloud) <= card.density else cloud[sample_indices(len(cloud), card.density, rng)]
    sample = np.ascontiguousarray(dense[sample_indices(len(dense), card.points, rng)])
    between()
    normals = estimate_normals(dense, sample, card.normal_neighbors, make=False)
    return Prepared(sample[None], normals[None], len(cloud), warnings)
