"""Settings of the bin and of the physics of the drops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from attentionvote.part import Parts
from attentionvote.section import check
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.bin_walls import Walls

# The bin of the IPA-like protocol, for slender parts of 143 mm.
REFERENCE_DIAMETER = 0.143
REFERENCE_BIN = (0.360, 0.280, 0.160)
# Heaps of bulky parts reach the rim when the parts' convex hulls take about half of the bin's volume.
_LARGEST_FILL = 0.45


@dataclass(frozen=True)
class BinSettings:
    """The bin.

    Raises:
        SettingError: when a setting is out of its range.
    """

    size: Annotated[
        tuple[float, float, float] | None,
        Setting("Inner length, width, height in metres; null = 360 x 280 x 160 mm scaled with D.", above=0, high=100),
    ] = None
    jitter: Annotated[
        float, Setting("Every side is multiplied by 1 - jitter .. 1 + jitter, once per cycle.", low=0, high=0.5)
    ] = 0.15
    walls: Annotated[
        Walls | None,
        Setting("Thickness, rim, corners and draft; null = thin upright walls.", identity=Identity.CHANGED),
    ] = None

    def __post_init__(self) -> None:
        if self.size is not None:
            object.__setattr__(self, "size", tuple(float(s) for s in self.size))
        check(self)
        if self.size is not None and self.walls is not None:
            smallest = np.array(self.size) * (1 - self.jitter)
            if problem := self.walls.problem(smallest):
                raise ValueError(f"bin {problem}")

    def scaling_diameter(self, parts: Parts, count: int) -> float:
        """The diameter in metres, relative to 143 mm, that bin and camera distance scale with.

        It is D of the largest part, or more for bulky parts, of which ``count`` would not fit into a bin scaled with D;
        with a given bin size, the diameter that belongs to its length.
        """
        if self.size is not None:
            return self.size[0] / REFERENCE_BIN[0] * REFERENCE_DIAMETER
        from scipy.spatial import ConvexHull

        volume = np.mean([ConvexHull(part.vertices).volume for part in parts.parts])
        fill = count * volume / np.prod(REFERENCE_BIN)
        return max(parts.diameter, float(REFERENCE_DIAMETER * (fill / _LARGEST_FILL) ** (1 / 3)))

    def sample(self, diameter: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """``(3,)`` inner size in metres for one cycle, ``diameter`` from :meth:`scaling_diameter`."""
        size = np.array(self.size or np.array(REFERENCE_BIN) * diameter / REFERENCE_DIAMETER)
        return size * rng.uniform(1 - self.jitter, 1 + self.jitter, size=3)


@dataclass(frozen=True)
class DropSettings:
    """Physics of the drops.

    Raises:
        SettingError: when a setting is out of its range.
        ValueError: when two do not fit together.
    """

    timestep: Annotated[
        float, Setting("Seconds; 0.008 with contact_time=0.02 is twice as fast.", low=1e-4, high=0.01)
    ] = 0.004
    contact_time: Annotated[
        float, Setting("Time constant of a contact in seconds (MuJoCo's solref[0]).", above=0, high=0.5)
    ] = 0.01
    friction: Annotated[
        tuple[float, float], Setting("Range of the sliding friction, drawn once per cycle.", above=0, high=2)
    ] = (0.2, 0.6)
    hull_threshold: Annotated[
        float, Setting("Concavity threshold of the convex decomposition (coacd's).", low=0.01, high=1)
    ] = 0.1
    hull_vertices: Annotated[int, Setting("Most vertices of one convex piece.", low=8, high=256)] = 64
    hull_volume: Annotated[
        float | None,
        Setting(
            "Most volume of the convex pieces, a multiple of the part's: the threshold is halved until it holds; "
            "null = as it comes.",
            low=1.01,
            high=100,
            identity=Identity.CHANGED,
        ),
    ] = None
    speed: Annotated[float, Setting("Downward speed at release, m/s.", above=0, high=5)] = 0.5
    timeout: Annotated[float, Setting("Longest time a drop may take, seconds.", above=0.25, high=30)] = 1.5
    area: Annotated[
        tuple[float, float] | None,
        Setting(
            "Length and width in metres of the piece of the floor that parts fall over, at a place drawn once per "
            "cycle; null = the whole floor.",
            above=0,
            high=100,
            identity=Identity.CHANGED,
        ),
    ] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "friction", tuple(float(f) for f in self.friction))
        if self.area is not None:
            object.__setattr__(self, "area", tuple(float(side) for side in self.area))
        check(self)
        if self.contact_time < 2 * self.timestep:
            raise ValueError(
                f"drop contact_time must be at least two time steps ({2 * self.timestep:g} s), got {self.contact_time}"
            )
        if self.friction[0] > self.friction[1]:
            raise ValueError(f"drop friction must be a range within 0..2, got {list(self.friction)}")
