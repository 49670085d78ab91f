"""The simulated depth camera: intrinsics, and where it stands relative to the bin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from attentionvote.geometry.pose import inverse, rotation_about, transform
from attentionvote.section import check
from attentionvote.setting import Setting

# A PhoXi M above a bin of 143 mm parts; the distance scales with the bin, so every bin fills the picture.
REFERENCE_DISTANCE = 0.80
REFERENCE_DIAMETER = 0.143


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics in pixels; pixel ``(u, v)`` has its centre at ``(u, v)``, OpenCV convention."""

    width: Annotated[int, Setting("Pixels.", low=8, high=16384)] = 1032
    height: Annotated[int, Setting("Pixels.", low=8, high=16384)] = 772
    fx: Annotated[float, Setting("Focal length, pixels.", above=0, high=1e6)] = 1700.0
    fy: Annotated[float, Setting("Focal length, pixels.", above=0, high=1e6)] = 1700.0
    cx: Annotated[float, Setting("Principal point, pixels.", low=0, high=1e6)] = 516.0
    cy: Annotated[float, Setting("Principal point, pixels.", low=0, high=1e6)] = 386.0

    def __post_init__(self) -> None:
        check(self)

    def rays(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Points ``(P, 2)`` of the plane z = 1 seen at pixels ``(P, 2)`` (u, v)."""
        return (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Pixels ``(..., 2)`` (u, v) of points ``(..., 3)`` in front of the camera, camera frame."""
        p = np.asarray(points, dtype=np.float64)
        return p[..., :2] / p[..., 2:] * (self.fx, self.fy) + (self.cx, self.cy)


@dataclass(frozen=True)
class CameraSettings:
    """How the camera of a scene is drawn; every scene has its own, so that consecutive piles differ in the picture.

    Raises:
        SettingError: when a setting is out of its range.
    """

    camera: Camera = field(default_factory=Camera)
    distance: Annotated[
        float | None, Setting("Metres to the bin's middle; null = 0.80 m scaled with the bin.", above=0, high=100)
    ] = None
    distance_jitter: Annotated[
        float, Setting("The distance varies by this share from scene to scene.", low=0, high=0.5)
    ] = 0.08
    shift: Annotated[float, Setting("Sideways jitter per axis, a share of the distance.", low=0, high=0.5)] = 0.015
    tilt_degrees: Annotated[float, Setting("The camera swings around the bin by up to so much.", low=0, high=60)] = 6.0
    roll_degrees: Annotated[float, Setting("Rotation about the viewing axis, +-.", low=0, high=180)] = 15.0

    def __post_init__(self) -> None:
        check(self)

    def sample(self, diameter: float, bin_height: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """``camera_from_bin`` ``(4, 4)``: the camera looks down at a point a third up the bin's axis, with jitter.

        Args:
            diameter: what the distance scales with, ``BinSettings.scaling_diameter``, metres.
            bin_height: metres.
            rng: decides the jitter.
        """
        distance = self.distance or REFERENCE_DISTANCE * diameter / REFERENCE_DIAMETER
        distance *= rng.uniform(1 - self.distance_jitter, 1 + self.distance_jitter)
        shift = rng.uniform(-1, 1, size=2) * self.shift * distance
        roll, azimuth = rng.uniform(-1, 1) * np.radians(self.roll_degrees), rng.uniform(0, 2 * np.pi)
        # Uniform over the spherical cap (to first order), not bunched at its pole.
        tilt = np.radians(self.tilt_degrees) * np.sqrt(rng.random())
        swing = rotation_about((np.cos(azimuth), np.sin(azimuth), 0.0), tilt)
        down = np.diag([1.0, -1.0, -1.0])  # camera axes in the bin frame: looking down, image x along bin x
        rotation = swing @ rotation_about((0.0, 0.0, 1.0), roll) @ down
        target = np.array([*shift, bin_height / 3])
        return inverse(transform(rotation, target - distance * rotation[:, 2]))
