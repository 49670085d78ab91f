"""Whole pictures of stored scenes: the depth and the owner of every pixel, as the writers of datasets take them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attentionvote.simulation.bin_walls import bin_outlines

if TYPE_CHECKING:
    from attentionvote.simulation.raycast import PartCaster
    from attentionvote.simulation.scene_record import SceneRecord


def depth_and_owner(
    record: SceneRecord, caster: PartCaster, parts: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Exact depth ``(H, W)`` in metres (inf where nothing is) and owner ``(H, W)``, -1 for the bin and nothing.

    Args:
        record: the scene.
        caster: of its parts.
        parts: False shows the empty bin.
    """
    camera = record.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    poses, kinds = (record.camera_from_part, record.part_ids) if parts else (np.zeros((0, 4, 4)), record.part_ids[:0])
    hits = caster.cast(poses, rays, record.bin_surface, kinds)
    return hits.depth.reshape(v.shape), hits.instance.reshape(v.shape)


def silhouettes(record: SceneRecord, caster: PartCaster) -> NDArray[np.bool_]:
    """``(I, H, W)`` what every part would show if it were alone, without bin."""
    camera = record.camera
    alone = np.zeros((record.drop_count, camera.height, camera.width), dtype=bool)
    for row in range(record.drop_count):
        pose, kind = record.camera_from_part[row : row + 1], record.part_ids[row : row + 1]
        u0, u1, v0, v1 = caster.pixel_box(pose, camera, kind)
        if u1 < u0 or v1 < v0:
            continue
        v, u = np.mgrid[v0 : v1 + 1, u0 : u1 + 1]
        hits = caster.cast(pose, camera.rays(np.stack([u.ravel(), v.ravel()], axis=1)), None, kind)
        alone[row, v0 : v1 + 1, u0 : u1 + 1] = (hits.instance == 0).reshape(v.shape)
    return alone


def depth_range(records: Sequence[SceneRecord], radius: float) -> tuple[float, float]:
    """Metres between which every depth of the scenes lies, with a hundredth to spare.

    Args:
        records: the scenes.
        radius: largest distance of a part's vertex from its origin.
    """
    low, high = np.inf, 0.0
    for record in records:
        x, y, height = record.bin_size * (0.5, 0.5, 1.0)
        corners = np.array([[sx * x, sy * y, z, 1.0] for sx in (-1, 1) for sy in (-1, 1) for z in (0.0, height)])
        if record.walls is not None:
            rings = np.concatenate(bin_outlines(record.bin_size, record.walls))
            corners = np.concatenate([rings, np.ones((len(rings), 1))], axis=1)
        bin_depth = (record.camera_from_bin @ corners.T)[2]
        part_depth = record.camera_from_part[:, 2, 3]
        low = min(low, bin_depth.min(), part_depth.min(initial=np.inf) - radius)
        high = max(high, bin_depth.max(), part_depth.max(initial=0.0) + radius)
    spare = 0.01 * (high - low)
    return max(low - spare, 0.0), high + spare


def camera_stands_still(records: Sequence[SceneRecord]) -> bool:
    """Whether one picture of the empty bin serves every scene of a cycle."""
    for _, cycle in groupby(records, key=lambda record: record.cycle):
        first, *rest = cycle
        if any(np.abs(other.camera_from_bin - first.camera_from_bin).max() > 1e-9 for other in rest):
            return False
    return True
