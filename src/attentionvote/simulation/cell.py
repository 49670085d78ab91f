"""The cell that a part is trained for: which sensor hangs how far above which bin. The section ``cell`` of an object.

An object without one is trained in the benchmark's protocol, whose lengths scale with D. ``command/cells.py`` writes a
cell's values into the settings of every verb, so nothing but that and ``make part`` knows of cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from attentionvote.section import check
from attentionvote.setting import Setting
from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.sensor import Sensor
from attentionvote.simulation.sensor_models import CUSTOM, SENSOR_MODELS


@dataclass(frozen=True)
class CellBin:
    """The bin of a cell."""

    size: Annotated[
        tuple[float, float, float], Setting("Inner length, width, height in metres, at the floor.", above=0, high=100)
    ]
    walls: Walls
    # A real bin is that bin: it varies little, as moulded ones and their wear do.
    jitter: Annotated[float, Setting("Share by which every side varies from cycle to cycle.", low=0, high=0.5)] = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(float(side) for side in self.size))
        check(self)
        if problem := self.walls.problem(np.array(self.size) * (1 - self.jitter)):
            raise ValueError(f"bin {problem}")


@dataclass(frozen=True)
class CellSettings:
    """What a part's training, evaluation, gates and view are simulated with.

    Raises:
        SettingError: when a setting is out of its range.
        ValueError: when the walls do not fit the bin, or the sensor does not measure it from that distance.
    """

    sensor: Annotated[str, Setting("Name of the sensor model, or custom.", choices=(*SENSOR_MODELS, CUSTOM))]
    distance: Annotated[float, Setting("Metres from the camera to the bin's middle.", above=0, high=100)]
    bin: CellBin
    camera: Camera
    measures: Annotated[Sensor | None, Setting("What the sensor measures; null = as conf/data has it.")] = None
    distance_jitter: Annotated[
        float, Setting("The distance varies by this share from scene to scene.", low=0, high=0.5)
    ] = 0.08
    area: Annotated[
        tuple[float, float] | None,
        Setting("Of the floor that parts fall over, length and width in metres; null = all.", above=0, high=100),
    ] = None
    hull_volume: Annotated[
        float | None,
        Setting("Most volume of the convex pieces, a multiple of the part's; null = as it comes.", low=1.01, high=100),
    ] = 1.2

    def __post_init__(self) -> None:
        check(self)
        model = SENSOR_MODELS.get(self.sensor)
        if model is not None and not model.near <= self.distance <= model.far:
            raise ValueError(
                f"cell distance must lie within {model.near:g}..{model.far:g} m, the range of {self.sensor}, got "
                f"{self.distance:g}: take {np.clip(self.distance, model.near, model.far):g}"
            )
        least = fitting_distance(self.camera, self.bin.size, self.bin.walls)
        if self.distance < least - 1e-9:
            size = " x ".join(f"{side:g}" for side in self.bin.size)
            raise ValueError(
                f"cell distance must be at least {np.ceil(least * 1000) / 1000:g} m, from where on the picture holds "
                f"the bin of {size} m; got {self.distance:g}"
            )


def fitting_distance(camera: Camera, size: tuple[float, float, float], walls: Walls) -> float:
    """The least distance (to a point a third up the bin's axis, metres) at which the picture holds the bin's rim, with
    a twentieth to spare. The bin's length lies along the picture's width."""
    # The nearer side of the picture decides where the principal point is not in its middle.
    across = min(camera.cx, camera.width - 1 - camera.cx) + 0.5, min(camera.cy, camera.height - 1 - camera.cy) + 0.5
    half_picture = np.array(across) / (camera.fx, camera.fy)
    return float((walls.outer_size(np.array(size)) / 2 / half_picture).max() * 1.05 + size[2] * 2 / 3)
