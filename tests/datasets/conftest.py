"""Piles of boxes before a camera, ray-cast exactly, as the arrays that writers take; no physics."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.datasets import PinholeCamera
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.raycast import BinSurface, PartCaster

CAMERA = Camera(120, 96, 200.0, 200.0, 57.0, 50.0)
CAMERA_FROM_BIN = transform(np.diag([1.0, -1.0, -1.0]), (0.01, -0.02, 0.9))
BIN_SIZE = np.array([0.45, 0.35, 0.1])


class Pile(NamedTuple):
    """A picture without noise: ``depth`` (inf where nothing is), ``instance``, ``alone`` (silhouettes), and poses."""

    camera: Camera
    depth: NDArray[np.float64]
    instance: NDArray[np.int32]
    alone: NDArray[np.bool_]
    camera_from_part: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    camera_from_bin: NDArray[np.float64]

    @property
    def pinhole(self) -> PinholeCamera:
        """The same camera as the writers take it."""
        c = self.camera
        return PinholeCamera(c.width, c.height, c.fx, c.fy, c.cx, c.cy)

    @property
    def exact_points(self) -> NDArray[np.float64]:
        """``(H, W, 3)`` by the ray caster's own camera, independent of any reader."""
        v, u = np.mgrid[0 : self.camera.height, 0 : self.camera.width]
        rays = self.camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(*u.shape, 2)
        return (
            np.concatenate([rays, np.ones((*u.shape, 1))], axis=-1)
            * np.nan_to_num(self.depth, posinf=np.nan)[..., None]
        )


@pytest.fixture(scope="session")
def make_pile(box: Part) -> Callable[..., Pile]:
    """A pile of ``count`` boxes (diameter 75 mm) at random poses above the middle of a bin; ``place`` shifts it."""
    caster = PartCaster(box)

    @cache
    def make(
        count: int, seed: int = 0, camera: Camera = CAMERA, with_bin: bool = True, place: tuple[float, ...] = (0, 0, 0)
    ) -> Pile:
        rng = np.random.default_rng([seed, count])
        middle = rng.uniform(-1, 1, (count, 3)) * (0.16, 0.12, 0.05) + (0.0, 0.0, 0.8) + place
        poses = transform(matrix_from_quaternion(random_quaternion(rng, (count,))), middle)
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
        surface = BinSurface(BIN_SIZE, CAMERA_FROM_BIN) if with_bin else None
        hits = caster.cast(poses, rays, surface)
        alone = np.array([caster.cast(pose[None], rays).instance.reshape(u.shape) == 0 for pose in poses])
        visible = caster.visible_fraction(poses, camera, surface, 1) if count else np.zeros(0)
        return Pile(
            camera, hits.depth.reshape(u.shape), hits.instance.reshape(u.shape), alone.reshape(count, *u.shape),
            poses, visible, CAMERA_FROM_BIN,
        )  # fmt: skip

    return make
