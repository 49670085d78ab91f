"""The shape of a real bin: walls of a thickness, leaning outward, rounded corners, a rim; rays and physics share it.

Bin frame: origin in the middle of the floor, z up. The inside is cut out by the floor and by inward half-spaces, one a
side and three a rounded corner, whose outline on the floor goes round the corner's arc; every half-space leans outward
by the draft. The mesh that rays meet and the pieces that parts touch have exactly these sides, so no part rests in a
wall that a ray sees elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from attentionvote.section import check
from attentionvote.setting import Setting

Floats = NDArray[np.float64]
# Angles, in shares of a quarter turn, of the half-spaces of a corner: the arc is met within 2 % of its radius.
_CORNER = (0.25, 0.5, 0.75)
_SOLID = 0.05  # metres


@dataclass(frozen=True)
class Walls:
    """Walls of a moulded bin, as load carriers have them. Lengths in metres.

    Raises:
        SettingError: when a setting is out of its range.
    """

    thickness: Annotated[float, Setting("Of walls and floor, metres.", above=0, high=0.1)] = 0.003
    rim: Annotated[float, Setting("How far the rim stands out of the wall's outside, metres.", low=0, high=0.2)] = 0.008
    rim_height: Annotated[float, Setting("Height of the rim from its top down, metres.", above=0, high=0.5)] = 0.008
    radius: Annotated[
        float, Setting("Of the upright corners inside, at the floor, metres; 0 = square.", low=0, high=0.5)
    ] = 0.010
    draft_degrees: Annotated[
        float, Setting("By which walls lean outward: the opening is wider than the floor.", low=0, high=30)
    ] = 2.0

    def __post_init__(self) -> None:
        check(self)

    def lean(self, height: float) -> float:
        """How much farther out a wall is ``height`` metres above the floor."""
        return float(height * np.tan(np.radians(self.draft_degrees)))

    def problem(self, size: Floats) -> str:
        """What does not fit a bin of the inner ``size`` ``(3,)``: a sentence, or an empty string."""
        if 2 * self.radius > min(size[:2]):
            most = min(size[:2]) / 2
            return f"walls.radius must be at most half of the bin's shorter side ({most:.4g} m), got {self.radius:g}"
        if self.rim_height > size[2]:
            return f"walls.rim_height must be at most the bin's height ({size[2]:.4g} m), got {self.rim_height:g}"
        return ""

    def outer_size(self, size: Floats) -> Floats:
        """``(2,)`` length and width over the rim, metres, of a bin of the inner ``size`` ``(3,)``."""
        return np.asarray(size[:2]) + 2 * (self.lean(float(size[2])) + self.thickness + self.rim)


def _sides(radius: float) -> tuple[Floats, Floats]:
    """Outward directions ``(K, 2)`` of the walls and corner half-spaces in turn, and ``(K, 2)`` which arc's centre each
    touches from: its signs in x and y."""
    quarters = np.arange(4)[:, None] * (np.pi / 2)
    shares = np.array([0.0, *_CORNER]) if radius > 0 else np.zeros(1)
    angles = (quarters + shares * (np.pi / 2)).ravel()
    corner = np.repeat(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), len(shares), axis=0)
    # Exact at quarter turns: walls are parallel to the axes.
    return np.stack([np.cos(angles), np.sin(angles)], axis=1).round(15), corner.astype(float)


def wall_planes(size: Floats, walls: Walls) -> tuple[Floats, Floats]:
    """The half-spaces whose intersection is the inside, floor left out.

    Args:
        size: ``(3,)`` inner length, width, height at the floor, metres.
        walls: the shape.

    Returns:
        Points ``(K, 3)`` on them, at the height of the floor, and inward unit normals ``(K, 3)``.
    """
    outward, corner = _sides(walls.radius)
    centre = corner * (np.asarray(size[:2]) / 2 - walls.radius)
    draft = np.radians(walls.draft_degrees)
    points = np.concatenate([centre + walls.radius * outward, np.zeros((len(outward), 1))], axis=1)
    up = np.full((len(outward), 1), np.sin(draft))
    return points, np.concatenate([-outward * np.cos(draft), up], axis=1)


def _outline(size: Floats, walls: Walls, out: float, z: float) -> Floats:
    """``(K, 3)`` corners, counter-clockwise from above, of the inner outline moved out by ``out`` metres."""
    outward, corner = _sides(walls.radius)
    radius = walls.radius + out
    reach = np.einsum("ki,ki->k", corner * (np.asarray(size[:2]) / 2 - walls.radius), outward) + radius
    # Where each side's line meets the next one's.
    following, reach_after = np.roll(outward, -1, axis=0), np.roll(reach, -1)
    determinant = outward[:, 0] * following[:, 1] - outward[:, 1] * following[:, 0]
    x = (reach * following[:, 1] - reach_after * outward[:, 1]) / determinant
    y = (outward[:, 0] * reach_after - following[:, 0] * reach) / determinant
    return np.stack([x, y, np.full(len(x), z)], axis=1)


def bin_outlines(size: Floats, walls: Walls) -> list[Floats]:
    """The rings ``(K, 3)`` between which the bin's surface lies, from the inner floor over the rim to the underside."""
    height = float(size[2])
    lean, thickness = walls.lean(height), walls.thickness
    under_rim = height - walls.rim_height
    rings = [(0.0, 0.0), (lean, height)]
    if walls.rim > 0:
        outside = lean + thickness + walls.rim
        rings += [(outside, height), (outside, under_rim), (walls.lean(under_rim) + thickness, under_rim)]
    else:
        rings.append((lean + thickness, height))
    # The underside: where the outer wall goes on down to.
    rings.append((thickness - min(walls.lean(thickness), thickness / 2), -thickness))
    return [_outline(size, walls, out, z) for out, z in rings]


def wall_pieces(size: Floats, walls: Walls) -> list[Floats]:
    """Corners ``(8, 3)`` of convex pieces that are the walls, one a side and half-space of a corner, up to the rim.

    Below the rim they are solid, and they go on beyond it outside: nothing comes there, nor tunnels through.
    """
    height, width = float(size[2]), walls.thickness + walls.rim + _SOLID
    rings = [
        _outline(size, walls, out, z)
        for out, z in (
            (0.0, 0.0),
            (walls.lean(height), height),
            (walls.lean(height) + width, height),
            (walls.lean(height) + width, 0.0),
        )
    ]
    count = len(rings[0])
    # The line of side i lies between the corners i - 1 and i.
    return [np.concatenate([ring[[i - 1, i]] for ring in rings]) for i in range(count)]


def bin_mesh(size: Floats, walls: Walls) -> tuple[Floats, NDArray[np.int64]]:
    """The bin as a closed surface, outward orientation: vertices ``(V, 3)`` in metres, bin frame, and faces ``(F, 3)``.

    Raises:
        ValueError: when the walls do not fit the bin.
    """
    if problem := walls.problem(size):
        raise ValueError(problem)
    rings = bin_outlines(size, walls)
    count = len(rings[0])
    first, second = np.arange(count), np.roll(np.arange(count), -1)
    faces = []
    for ring in range(len(rings) - 1):
        a, b, c, d = (
            first + ring * count,
            second + ring * count,
            second + (ring + 1) * count,
            first + (ring + 1) * count,
        )
        faces += [np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)]
    fan = np.stack([np.zeros(count - 2, dtype=np.int64), first[1:-1], second[1:-1]], axis=1)
    faces += [fan, fan[:, ::-1] + (len(rings) - 1) * count]  # the floor looks up, the underside down
    return np.concatenate(rings), np.concatenate(faces).astype(np.int64)
