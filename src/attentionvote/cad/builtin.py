"""Catalogue of the built-in parts: procedural CAD, true to the millimetre, watertight.

Conventions of all nine: the origin is the centre of the bounding box, as in the public Siléane and IPA
meshes; the symmetry axis is z and passes through the origin; D is the largest vertex distance and is
exactly the nominal one, because the finished solid is scaled to it (by a few per cent at most).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray

from attentionvote.cad import builtin_industrial as industrial
from attentionvote.cad import builtin_standins as standins
from attentionvote.cad.mesh_file import largest_vertex_distance
from attentionvote.geometry.symmetry import Symmetry


@dataclass(frozen=True)
class BuiltinPart:
    """One entry: how it is built, its D in metres, its proper symmetry and a title."""

    build: Callable[[], Manifold]
    diameter: float
    symmetry: Symmetry
    title: str


C2 = Symmetry("cyclic", order=2)
REVOLUTION = Symmetry("revolution")

BUILTIN_PARTS: dict[str, BuiltinPart] = {
    "connecting_rod": BuiltinPart(industrial.connecting_rod, 0.143, C2, "Connecting rod, 143 mm"),
    "vertical_bearing_pedestal": BuiltinPart(
        industrial.vertical_bearing_pedestal, 0.165, Symmetry(), "Vertical bearing pedestal, 165 mm"
    ),
    "slider_bearing_pedestal": BuiltinPart(
        industrial.slider_bearing_pedestal, 0.125, C2, "Slider bearing pedestal, 125 mm"
    ),
    "brick": BuiltinPart(standins.brick, 0.037, C2, "Brick, 37 mm (stand-in for Siléane's)"),
    "gear": BuiltinPart(standins.gear, 0.121, REVOLUTION, "Gear, 121 mm (stand-in for Siléane's, no teeth)"),
    "candlestick": BuiltinPart(standins.candlestick, 0.191, REVOLUTION, "Candlestick, 191 mm (stand-in for Siléane's)"),
    "pepper": BuiltinPart(standins.pepper, 0.335, REVOLUTION, "Pepper mill, 335 mm (stand-in for Siléane's)"),
    "ring_screw": BuiltinPart(standins.ring_screw, 0.155, C2, "Ring screw, 155 mm (stand-in for IPA's)"),
    "gear_shaft": BuiltinPart(standins.gear_shaft, 0.437, REVOLUTION, "Gear shaft, 437 mm (stand-in for IPA's)"),
}


@cache
def builtin_surface(name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` in metres and faces ``(F, 3)`` of a built-in part; treat them as read-only.

    Raises:
        ValueError: when there is no such part; the sentence names the nearest one.
    """
    if name not in BUILTIN_PARTS:
        nearest = get_close_matches(name, BUILTIN_PARTS, n=1, cutoff=0.0)
        raise ValueError(
            f"mesh 'builtin:{name}' must be one of {', '.join(BUILTIN_PARTS)}; did you mean 'builtin:{nearest[0]}'?"
        )
    entry = BUILTIN_PARTS[name]
    # Booleans leave slivers far below any tolerance of manufacture; they cost triangles and nothing else.
    mesh = entry.build().simplify(1e-3).to_mesh64()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    faces = np.asarray(mesh.tri_verts, dtype=np.int64)
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    vertices *= entry.diameter / largest_vertex_distance(vertices)
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces
