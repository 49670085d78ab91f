"""What a sensor can tell of a part before anything is simulated: pixels across it, points on it, noise against D."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from attentionvote.part import Part, Parts
from attentionvote.simulation.camera import REFERENCE_DISTANCE, Camera
from attentionvote.simulation.cell import fitting_distance
from attentionvote.simulation.cell_choice import walls_for
from attentionvote.simulation.drop_settings import REFERENCE_DIAMETER
from attentionvote.simulation.scene_spec import SimulationSettings
from attentionvote.simulation.sensor import Sensor
from attentionvote.simulation.sensor_models import SENSOR_MODELS

# Of D, beyond which models measured in docs and sweeps lose poses at 5 % of D: 0.7 % of D costs a tenth of the average
# precision there, 1.4 % five sixths of it.
TOLERATED_NOISE = 0.01
# Of a part seen whole, below which normals are of neighbours beside the part.
FEWEST_POINTS = 100


class Resolution(NamedTuple):
    """Figures of the smallest part in the bin.

    Attributes:
        part: its name.
        diameter: D, metres.
        distance: metres from the camera.
        pixels: across D.
        points: on a part that is seen whole, at most as many as its pixels; normals are made of these.
        noise: standard deviation along the ray, metres, seen straight on.
        bin: inner size in metres, where it is one of the world's.
    """

    part: str
    diameter: float
    distance: float
    pixels: float
    points: float
    noise: float
    bin: tuple[float, float, float] | None = None

    @property
    def noise_share(self) -> float:
        """Noise as a share of D."""
        return self.noise / self.diameter

    def sentence(self) -> str:
        """The figures for people."""
        noise = f", noise {self.noise * 1000:.3g} mm or {self.noise_share:.1%} of D" if self.noise else ""
        return (
            f"{self.part}, D {self.diameter * 1000:.4g} mm, at {self.distance * 1000:.0f} mm: {self.pixels:.0f} pixels "
            f"across, about {self.points:.0f} points on a part seen whole{noise}"
        )

    def advice(self) -> str:
        """What to do where the part is too small for the sensor; empty where it is not."""
        problems = []
        if self.noise_share > TOLERATED_NOISE:
            hit = "will be near 0" if self.noise_share > 2 * TOLERATED_NOISE else "will suffer"
            problems.append(f"noise is {self.noise_share:.1%} of D: AP at 5 % D {hit}")
        if self.points < FEWEST_POINTS:
            problems.append(f"{self.points:.0f} points on a part are too few for its normals")
        if not problems:
            return ""
        better, smaller_bin = self._better(self.bin), ""
        if not better and self.bin is not None:
            better, smaller_bin = self._better(None), " over a smaller bin"
        return f"{' and '.join(problems)}; " + (
            f"take {' or '.join(better[:3])}{smaller_bin}"
            if better
            else "no sensor that is known here measures so small a part well"
        )

    def _better(self, size: tuple[float, float, float] | None) -> list[str]:
        """Sensors, and from where, whose noise and pixels suit the part, and whose picture holds the bin."""
        found = []
        for name, model in SENSOR_MODELS.items():
            least = 0.0 if size is None else fitting_distance(model.camera, size, walls_for(size))
            distance = round(max(model.best, float(np.ceil(least * 1000)) / 1000), 3)
            quiet = model.noise(distance) <= TOLERATED_NOISE * self.diameter
            # As many pixels across as put 100 on the part.
            if distance <= model.far and quiet and model.camera.fx * self.diameter / distance >= 15:
                found.append(f"{name} at {distance * 1000:.0f} mm")
        return found


def resolution(
    parts: Parts,
    camera: Camera,
    distance: float,
    sensor: Sensor,
    density: int,
    count: int,
    size: tuple[float, float, float] | None = None,
) -> Resolution:
    """Figures of the smallest part.

    Args:
        parts: what lies in the bin.
        camera: its intrinsics.
        distance: metres.
        sensor: its noise.
        density: most points of a cloud.
        count: parts in the bin that share them.
        size: of the bin inside, metres, where it is one of the world's.
    """
    part: Part = min(parts.parts, key=lambda member: member.diameter)
    pixel = distance / camera.fx  # metres
    points = min(_silhouette(part) / (pixel * distance / camera.fy), density / count)
    return Resolution(
        part.name, part.diameter, distance, part.diameter / pixel, points, noise_of(sensor, distance), size
    )


def noise_of(sensor: Sensor, distance: float) -> float:
    """Standard deviation in metres along the ray of points at ``distance`` metres, seen straight on."""
    if sensor.preset == "phoxi":
        return sensor.axial_sigma_mm / 1000 * (distance / 0.65) ** 2
    return sensor.sigma_mm / 1000 if sensor.preset == "gaussian" else 0.0


def simulated_distance(parts: Parts, settings: SimulationSettings) -> float:
    """Metres from the camera to the bin in a simulation."""
    if settings.camera.distance is not None:
        return settings.camera.distance
    scale = settings.bin.scaling_diameter(parts, settings.drop_counts[-1])
    return REFERENCE_DISTANCE * scale / REFERENCE_DIAMETER


def log_resolution(
    log: logging.Logger,
    parts: Parts,
    settings: SimulationSettings,
    sensor: Sensor | None = None,
    density: int = 40_000,
) -> None:
    """Say before any work what the sensor can tell of the smallest part, with a warning where that is too little; the
    noise only where the sensor is known."""
    distance = simulated_distance(parts, settings)
    size = settings.bin.size if settings.bin.walls is not None else None
    count = settings.drop_counts[-1]
    found = resolution(parts, settings.camera.camera, distance, sensor or Sensor(), density, count, size)
    log.info("%s", found.sentence())
    if advice := found.advice():
        log.warning("%s", advice)


def _silhouette(part: Part) -> float:
    """Mean area of the part's convex hull as seen from everywhere, m^2: a quarter of its surface (Cauchy)."""
    from scipy.spatial import ConvexHull

    return float(ConvexHull(part.vertices).area) / 4
