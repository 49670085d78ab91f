"""Mass, centre and inertia of a part, as the physics is given them: the same bits on every processor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part

_DENSITY = 2700.0  # kg/m^3; piles do not depend on it, contacts are normalised by mass
_DIGITS = 9  # of a moment of inertia


class Mass(NamedTuple):
    """Mass in kg, centre ``(3,)`` in metres and inertia ``(3, 3)`` about it in kg m^2, part frame."""

    mass: float
    centre: NDArray[np.float64]
    inertia: NDArray[np.float64]


def mass_properties(part: Part) -> Mass:
    """Those of the solid inside the part's surface; of its hull if it is not closed."""
    import trimesh

    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    if not mesh.is_watertight or mesh.volume <= 0:
        mesh = mesh.convex_hull
    mesh.density = _DENSITY
    inertia = inertia_of(part.symmetry, np.array(mesh.moment_inertia))
    return Mass(float(mesh.mass), np.array(mesh.center_mass), inertia)


def inertia_of(symmetry: Symmetry, inertia: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inertia ``(3, 3)`` that a part of this symmetry has; ``inertia`` is of its mesh.

    Only a part of revolution is changed: its two moments across the axis are made equal, and all are rounded. The two
    differ by the last bits of sums, which are not the same on every processor, and which alone choose the principal
    axes that the physics turns the body in: candlesticks fell into other piles with AVX-512 than with AVX2.
    """
    if symmetry.kind != "revolution":
        return inertia
    axis = np.asarray(symmetry.axis, dtype=np.float64)
    along = float(axis @ inertia @ axis)
    across = (float(np.trace(inertia)) - along) / 2
    along, across = (float(f"{moment:.{_DIGITS - 1}e}") for moment in (along, across))
    return across * np.eye(3) + (along - across) * np.outer(axis, axis)
