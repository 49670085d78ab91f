"""Scenes as a sensor delivers them, and as the network sees them: noise, density, pool, normals."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pointcloud import estimate_normals, sample_indices
from attentionvote.scene import BACKGROUND, Scene
from attentionvote.section import identifying
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.sensor import Sensor, synthesize

_VERSION = 1


@dataclass(frozen=True)
class CloudSettings:
    """What is measured of a scene.

    Args:
        sensor: the sensor and its noise.
        density: most points of the cloud on which normals are estimated; the cell must use the same.
        pool: points kept of it.
        neighbors: of the normal estimation.
    """

    sensor: Sensor
    density: int = 40_000
    pool: int = 16_384
    neighbors: int = 30

    def __post_init__(self) -> None:
        if not 1 <= self.pool <= self.density:
            raise ValueError(f"pool must lie in 1..{self.density} (density), got {self.pool}")

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Self:
        """Those that a checkpoint keeps as plain values."""
        return cls(**{**stored, "sensor": Sensor(**stored["sensor"])})

    def key(self, scene_digest: str) -> str:
        """Digest of everything that determines the stored clouds."""
        content = json.dumps([_VERSION, scene_digest, identifying(self)], sort_keys=True, default=str)
        return hashlib.sha256(content.encode()).hexdigest()


def sense(record: SceneRecord, caster: PartCaster, settings: CloudSettings) -> tuple[Scene, np.random.Generator]:
    """One scene as the sensor delivers it, up to ``density`` points, and the scene's own random numbers after it."""
    rng = np.random.default_rng(np.random.SeedSequence(record.scene_seed))
    return synthesize(record, caster, settings.sensor, settings.density, rng), rng


def unlabelled(points: NDArray[np.floating], density: int, rng: np.random.Generator) -> Scene:
    """A cloud whose instances nobody knows, up to ``density`` points; rows that are not finite are missing.

    Raises:
        ValueError: when it is not ``(P, 3)`` or fewer than three points are left.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (P, 3), got {points.shape}")
    cloud = points[np.isfinite(points).all(axis=1)].astype(np.float32)
    if len(cloud) < 3:
        raise ValueError(f"points must hold at least 3 measured points, got {len(cloud)}")
    cloud = cloud[sample_indices(len(cloud), min(density, len(cloud)), rng)]
    no_one = np.full(len(cloud), BACKGROUND, np.int32)
    return Scene(cloud, no_one, np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, np.int32))


def measure(record: SceneRecord, caster: PartCaster, settings: CloudSettings) -> Scene:
    """One scene as the network will see it: noisy points of the pool with normals from the whole cloud.

    The random numbers come from the scene's own seed, so the cloud does not depend on who measures it and when.
    """
    return with_normals(*sense(record, caster, settings), settings)


def with_normals(scene: Scene, rng: np.random.Generator, settings: CloudSettings) -> Scene:
    """Points of the pool of a sensed scene, with normals from all of its points; empty where there are too few."""
    if len(scene.points) < 3:
        empty = np.zeros((0, 3), dtype=np.float32)
        return Scene(
            empty, np.zeros(0, np.int32), scene.camera_from_part, scene.visible_fraction, scene.part_ids, empty
        )
    rows = sample_indices(len(scene.points), min(settings.pool, len(scene.points)), rng)
    points = scene.points.take(rows, axis=0)
    normals = estimate_normals(scene.points, points, settings.neighbors)
    ids = scene.instance_ids[rows]
    return Scene(points, ids, scene.camera_from_part, scene.visible_fraction, scene.part_ids, normals)
