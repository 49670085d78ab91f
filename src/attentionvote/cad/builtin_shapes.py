"""Solid primitives for the built-in CAD: what an engineer would sketch, in millimetres.

Every function returns a ``manifold3d.Manifold``; ``+``, ``-`` and ``^`` are union, difference and
intersection. Circles have an even number of sides, so that a half turn maps a solid onto itself exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

Point = tuple[float, float]
SIDES_LARGE, SIDES_SMALL = 48, 24


def cylinder(
    radius: float, low: float, high: float, x: float = 0.0, y: float = 0.0, top: float | None = None
) -> Manifold:
    """Upright cylinder (or cone frustum with radius ``top``) between the heights ``low`` and ``high``."""
    sides = SIDES_SMALL if radius < 10 else SIDES_LARGE
    solid = Manifold.cylinder(high - low, radius, radius if top is None else top, sides)
    return solid.translate((x, y, low))


def lying_cylinder(radius: float, front: float, back: float, z: float, top: float | None = None) -> Manifold:
    """Cylinder along y from ``front`` to ``back`` (radius ``top`` there), its axis at height ``z``."""
    sides = SIDES_SMALL if radius < 10 else SIDES_LARGE
    solid = Manifold.cylinder(back - front, radius, radius if top is None else top, sides)
    return solid.rotate((-90, 0, 0)).translate((0, front, z))


def box(x: Point, y: Point, z: Point) -> Manifold:
    """Axis-parallel box between the given (low, high) pairs."""
    solid = Manifold.cube((x[1] - x[0], y[1] - y[0], z[1] - z[0]))
    return solid.translate((x[0], y[0], z[0]))


def disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    """Plane disc around (x, y)."""
    return CrossSection.circle(radius, SIDES_SMALL if radius < 10 else SIDES_LARGE).translate((x, y))


def rectangle(width: float, height: float, corner: float = 0.0) -> CrossSection:
    """Plane rectangle around the origin, with corners rounded by ``corner``."""
    if corner == 0:
        return CrossSection.square((width, height), True)
    inner = CrossSection.square((width - 2 * corner, height - 2 * corner), True)
    return inner.offset(corner, JoinType.Round, circular_segments=SIDES_SMALL)


def filleted(outline: CrossSection, radius: float) -> CrossSection:
    """``outline`` with its inner corners rounded by ``radius`` (a morphological closing)."""
    grown = outline.offset(radius, JoinType.Round, circular_segments=2 * SIDES_LARGE)
    return grown.offset(-radius, JoinType.Round, circular_segments=SIDES_LARGE)


def plate(outline: CrossSection, low: float, high: float) -> Manifold:
    """``outline`` (x, y) extruded between two heights."""
    return Manifold.extrude(outline, high - low).translate((0, 0, low))


def upright_plate(outline: CrossSection, front: float, back: float) -> Manifold:
    """``outline`` drawn in (x, z), standing upright between the depths ``front`` and ``back`` along y."""
    return Manifold.extrude(outline, back - front).rotate((90, 0, 0)).translate((0, back, 0))


def turned(profile: Sequence[Point], sides: int = 48) -> Manifold:
    """Body of revolution about z of a closed profile of (radius, height) corners, counter-clockwise."""
    return Manifold.revolve(CrossSection([np.asarray(profile, dtype=np.float64)]), sides)


def ring(radius: float, thickness: float, sides: int = 48, thickness_sides: int = 12) -> Manifold:
    """Torus standing in the xz plane: circle of ``radius`` swept by a disc of radius ``thickness``."""
    return Manifold.revolve(CrossSection.circle(thickness, thickness_sides).translate((radius, 0)), sides).rotate(
        (90, 0, 0)
    )
