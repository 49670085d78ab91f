"""Simulated depth sensor: the point cloud that it would deliver of a stored scene.

Rays are cast at random pixels of the picture, so a cloud of 40,000 points costs 40,000 hits, not a whole image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from attentionvote.scene import Scene
from attentionvote.section import check
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.ray_selection import random_order

if TYPE_CHECKING:
    from attentionvote.simulation.raycast import BinSurface, Floats, Hits, PartCaster
    from attentionvote.simulation.scene_record import SceneRecord

PRESETS = ("none", "gaussian", "phoxi")
# Lengths of the phoxi preset are for this working distance and scale with the scene's, as the vendor's sizes do.
_WORKING_DISTANCE = 0.80


@dataclass(frozen=True)
class Sensor:
    """A depth sensor.

    The phoxi figures follow public data sheets of the Photoneo PhoXi M (other models: ``sensor_models``); they were not
    fitted to a real sensor. ``baseline`` and ``edge_jump`` are lengths of one device where ``scaled`` is false; where
    it is true they hold at 0.80 m and scale with the working distance, as the vendor's sizes do.

    Raises:
        SettingError: when a setting is out of its range.
        ValueError: when two do not fit together.
    """

    preset: Annotated[
        str,
        Setting(
            "none (exact points: the paper's data), gaussian (isotropic noise) or phoxi (a structured-light scanner).",
            choices=PRESETS,
        ),
    ] = "none"
    sigma_mm: Annotated[
        float, Setting("gaussian: standard deviation per axis; keep it under 2 % of D.", low=0, high=100)
    ] = 0.3
    axial_sigma_mm: Annotated[
        float,
        Setting("phoxi: noise along the ray at 0.65 m, grows with z^2 / cos(incidence).", low=0, high=100),
    ] = 0.1
    grazing_degrees: Annotated[
        tuple[float, float],
        Setting("phoxi: incidence at which points begin to be lost, and all are.", low=0, high=90),
    ] = (70.0, 85.0)
    baseline: Annotated[
        float, Setting("phoxi: metres from camera to projector, whose shadows are lost.", low=0, high=100)
    ] = 0.27
    edge_jump: Annotated[
        float, Setting("phoxi: metres of depth between neighbouring pixels that make an edge.", above=0, high=1)
    ] = 0.003
    edge_dropout: Annotated[float, Setting("phoxi: share of edge points lost.", low=0, high=1)] = 0.5
    edge_flying: Annotated[
        float, Setting("phoxi: share of edge points that land between the two surfaces.", low=0, high=1)
    ] = 0.1
    dropout: Annotated[float, Setting("phoxi: share of points lost anywhere.", low=0, high=1)] = 0.01
    specular: Annotated[
        float,
        Setting("phoxi: share of points lost within 5 degrees of mirror reflection into the camera.", low=0, high=1),
    ] = 0.0
    scaled: Annotated[
        bool,
        Setting(
            "phoxi: whether baseline and edge_jump hold at 0.80 m and scale with the distance; false = as they are.",
            identity=Identity.CHANGED,
        ),
    ] = True
    noise_pixels: Annotated[
        float,
        Setting(
            "phoxi: pixels over which noise is alike, as a stereo camera's matching windows make it; 0 = none.",
            low=0,
            high=64,
            identity=Identity.CHANGED,
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "grazing_degrees", tuple(float(g) for g in self.grazing_degrees))
        check(self)
        if self.edge_dropout + self.edge_flying > 1:
            raise ValueError(
                f"sensor edge_dropout + edge_flying must be at most 1, got {self.edge_dropout + self.edge_flying:g}"
            )
        if self.grazing_degrees[0] >= self.grazing_degrees[1]:
            raise ValueError(f"sensor grazing_degrees must be a range within 0..90, got {list(self.grazing_degrees)}")


def synthesize(
    record: SceneRecord, caster: PartCaster, sensor: Sensor, max_points: int, rng: np.random.Generator
) -> Scene:
    """Point cloud of a scene: the parts' points only, at random pixels, in random order.

    Args:
        record: the stored scene.
        caster: of the part, or of the set of parts, in the scene.
        sensor: which effects to apply; noise is in the points, so normals estimated later see it.
        max_points: most points; fewer when the picture has no more.
        rng: decides pixels and noise.

    Returns:
        A scene without normals.

    Raises:
        ValueError: when ``max_points`` is not positive.
    """
    if max_points < 1:
        raise ValueError(f"max_points must be at least 1, got {max_points}")
    poses, surface = record.camera_from_part, record.bin_surface
    scanner = _Scanner(record, caster, sensor, rng) if sensor.preset == "phoxi" else None
    u0, u1, v0, v1 = caster.pixel_box(poses, record.camera, record.part_ids)
    width, height = max(u1 - u0 + 1, 0), max(v1 - v0 + 1, 0)
    order = random_order(width * height, rng)
    points: list[Floats] = []
    ids: list[NDArray[np.int32]] = []
    measured_count, used = 0, 0
    while measured_count < max_points and used < len(order):
        # The share of pixels that end as points is guessed for the first rays and known for the rest.
        yielded = measured_count / used if used else 0.5
        batch = int((max_points - measured_count) / max(yielded, 0.02) * 1.03) + 64
        pixel_ids = order[used : used + batch]
        used += len(pixel_ids)
        pixels = np.stack([pixel_ids % width + u0, pixel_ids // width + v0], axis=1)
        rays, incidence = record.camera.rays(pixels), scanner is not None
        hits = caster.cast(poses, rays, surface, record.part_ids, background=False, normals=incidence)
        if scanner is not None:
            new_points, new_ids = scanner.measure(pixels, hits)
        else:
            foreground = np.flatnonzero(hits.instance >= 0)
            new_points = _points(rays.take(foreground, axis=0), hits.depth[foreground])
            new_ids = hits.instance[foreground]
        points.append(new_points)
        ids.append(new_ids)
        measured_count += len(new_points)
    cloud = np.concatenate([np.zeros((0, 3)), *points])[:max_points]
    if sensor.preset == "gaussian":
        cloud = cloud + rng.normal(scale=sensor.sigma_mm / 1000, size=cloud.shape)
    return Scene(
        points=cloud.astype(np.float32),
        instance_ids=np.concatenate([np.zeros(0, dtype=np.int32), *ids])[:max_points],
        camera_from_part=poses,
        visible_fraction=record.visible_fraction,
        part_ids=record.part_ids,
    )


class CorrelatedNoise:
    """Standard normal noise of a picture whose neighbouring pixels have nearly the same: values of a random grid,
    interpolated, of variance 1 everywhere."""

    def __init__(self, width: int, height: int, length: float, rng: np.random.Generator) -> None:
        """``length``: spacing of the grid in pixels, over which the noise is correlated."""
        self._length = length
        self._grid = rng.normal(size=(int(width / length) + 2, int(height / length) + 2))

    def __call__(self, pixels: NDArray[np.int32]) -> Floats:
        """Noise ``(P,)`` at pixels ``(P, 2)`` (u, v) within the picture."""
        at = pixels / self._length
        cell = np.floor(at).astype(np.int64)
        right, down = (at - cell).T
        noise, power = np.zeros(len(pixels)), np.zeros(len(pixels))
        for i, across in enumerate((1 - right, right)):
            for j, along in enumerate((1 - down, down)):
                noise += across * along * self._grid[cell[:, 0] + i, cell[:, 1] + j]
                power += (across * along) ** 2
        return noise / np.sqrt(power)


def _points(rays: Floats, depth: Floats) -> Floats:
    """``(P, 3)`` camera frame: where rays ``(P, 2)`` have a depth."""
    points = np.empty((len(rays), 3))
    for axis in range(2):  # column by column: a third of the time of arrays (P, 2)
        np.multiply(rays[:, axis], depth, out=points[:, axis])
    points[:, 2] = depth
    return points


class _Scanner:
    """The phoxi preset on one scene; which side the projector is on is drawn once."""

    def __init__(self, record: SceneRecord, caster: PartCaster, sensor: Sensor, rng: np.random.Generator) -> None:
        self.record, self.caster, self.sensor, self.rng = record, caster, sensor, rng
        nearness = float(record.camera_from_bin[2, 3]) / _WORKING_DISTANCE
        self.scale = nearness if sensor.scaled else 1.0
        # A point must not be shadowed by its own surface, metres.
        self.margin = 5e-4 * nearness
        # One grid a scene: pixels are measured in several batches.
        self._correlated = (
            CorrelatedNoise(record.camera.width, record.camera.height, sensor.noise_pixels, rng)
            if sensor.noise_pixels > 0
            else None
        )
        side = rng.choice([-1.0, 1.0])
        self.projector = np.array([side * sensor.baseline * self.scale, 0.0, 0.0])
        self.poses_from_projector = record.camera_from_part.copy()
        self.poses_from_projector[:, :3, 3] -= self.projector
        self.surface_from_projector: BinSurface = record.bin_surface.moved(self.projector)

    def measure(self, pixels: NDArray[np.int32], hits: Hits) -> tuple[Floats, NDArray[np.int32]]:
        """Points ``(Q, 3)`` and their instances of those pixels at which the scanner measures a part."""
        sensor, rng = self.sensor, self.rng
        keep = np.flatnonzero(hits.instance >= 0)
        keep = keep[rng.random(len(keep)) >= sensor.dropout]
        rays = self.record.camera.rays(pixels[keep])
        points = _points(rays, hits.depth[keep])
        cosine, lost = self._reflection(points, hits.normal[keep])
        seen = rng.random(len(keep)) >= lost
        keep, points, cosine = keep[seen], points[seen], cosine[seen]
        shadow = self.caster.blocked(
            self.poses_from_projector,
            points - self.projector,
            self.margin,
            self.surface_from_projector,
            self.record.part_ids,
        )
        keep, points, cosine = keep[~shadow], points[~shadow], cosine[~shadow]
        z, lost_at_edge = self._edges(pixels[keep], points[:, 2])
        sigma = sensor.axial_sigma_mm / 1000 * (z / 0.65) ** 2 / np.maximum(cosine, 0.2)
        noise = self._noise(pixels[keep])
        noisy = z + noise * sigma
        points = points * (noisy / points[:, 2])[:, None]
        return points[~lost_at_edge], hits.instance[keep[~lost_at_edge]]

    def _noise(self, pixels: NDArray[np.int32]) -> Floats:
        """Standard normal noise of pixels ``(P, 2)``."""
        if self._correlated is not None:
            return self._correlated(pixels)
        return self.rng.normal(size=len(pixels))

    def _reflection(self, points: Floats, normal: Floats) -> tuple[Floats, Floats]:
        """Cosine of the incidence at the camera, and probability that the point is lost to grazing or glare."""
        to_camera = -points / np.linalg.norm(points, axis=1, keepdims=True)
        to_projector = self.projector - points
        to_projector /= np.linalg.norm(to_projector, axis=1, keepdims=True)
        cosine = np.einsum("pi,pi->p", normal, to_camera)
        worst = np.minimum(cosine, np.einsum("pi,pi->p", normal, to_projector))
        angle = np.degrees(np.arccos(np.clip(worst, -1, 1)))
        start, end = self.sensor.grazing_degrees
        lost = np.clip((angle - start) / (end - start), 0, 1)
        if self.sensor.specular > 0:
            half = to_camera + to_projector
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            mirror = np.einsum("pi,pi->p", normal, half) > np.cos(np.radians(5))
            lost = np.maximum(lost, mirror * self.sensor.specular)
        return cosine, lost

    def _edges(self, pixels: NDArray[np.int32], z: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depth after flying pixels, and which points an edge swallows; looks at the four neighbouring pixels."""
        neighbours = (pixels[:, None] + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])).reshape(-1, 2)
        rays = self.record.camera.rays(neighbours)
        record = self.record
        hits = self.caster.cast(record.camera_from_part, rays, record.bin_surface, record.part_ids, normals=False)
        depth = hits.depth.reshape(-1, 4)
        jump = np.abs(depth - z[:, None])
        edge = jump.max(axis=1, initial=0) > self.sensor.edge_jump * self.scale
        # A mixed measurement lies between this surface and the farthest-off neighbour that reflects at all.
        finite = np.where(np.isfinite(depth), jump, -1)
        other = np.take_along_axis(depth, finite.argmax(axis=1)[:, None], axis=1)[:, 0]
        fate = self.rng.random(len(z))
        lost = edge & (fate < self.sensor.edge_dropout)
        flying = edge & ~lost & (fate < self.sensor.edge_dropout + self.sensor.edge_flying) & np.isfinite(other)
        weight = self.rng.random(len(z))
        return np.where(flying, z + weight * (np.where(flying, other, z) - z), z), lost
