"""How far the flat facets of a tessellated curve lie from the curve they stand for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FLAT = np.radians(0.05)  # two triangles that turn less are one facet
# A circle of 16 facets turns by 22.5 degrees at each edge. What turns more is meant: a hexagon, a tooth, a chamfer.
SMOOTH = np.radians(22.5) + 1e-3
# A small bore is often tessellated coarser: of 9 facets and more it is a circle, where no sensor sees the difference.
COARSE, UNSEEN = np.radians(41.0), 0.002  # turn at an edge; height, a share of the surface's size
UNEVEN = 3.0  # what is more times as wide as the facet beside it is a plane beside a fillet, and flat
ROUND = 8 / 3  # a triangle inscribed in a sphere lies so much deeper than the strip of a cylinder of the same turns
MOST_CORNERS = 64  # of a facet; larger ones are planes


def facet_heights(vertices: Array, faces: Index) -> Array:
    """Sagitta ``(F,)`` in metres of the facet that each triangle belongs to; 0 where the surface is meant to be flat.

    Coplanar triangles are one facet. A facet stands for a piece of a curved surface when at least two of its edges
    turn by no more than those of a circle of 16 facets do (of 9, where the height is below ``UNSEEN``); with the turn
    ``t`` and the widths ``a`` and ``b`` of both facets, the curve has the radius ``(a + b) / 2 t`` and its height over
    the first is ``a^2 t / 4 (a + b)``, on a surface that is curved both ways (three such edges and more) ``ROUND``
    times that.

    Args:
        vertices: ``(V, 3)`` metres.
        faces: ``(F, 3)`` of a closed surface.
    """
    first, second, edges = _adjacent(faces)
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(length > 0, length, 1.0)[:, None]
    a, b = normals[first], normals[second]
    # The half chord is exact for small angles, where arccos is not.
    turn = 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1))
    is_flat = (turn < FLAT) | (length[first] == 0) | (length[second] == 0)
    links = coo_array((np.ones(is_flat.sum()), (first[is_flat], second[is_flat])), shape=(len(faces), len(faces)))
    facet = connected_components(links, directed=False)[1]
    is_smooth = ~is_flat & (turn <= COARSE)
    first, second, turn, edges = (x[is_smooth] for x in (facet[first], facet[second], turn, edges))
    # A facet with one smooth edge only is a plane that ends in a bend or a fillet.
    neighbours = np.unique(np.concatenate([np.stack([first, second], 1), np.stack([second, first], 1)]), axis=0)
    smooth_edges = np.bincount(neighbours[:, 0], minlength=facet.max() + 1)
    has_two = smooth_edges >= 2
    is_curve = has_two[first] & has_two[second] & (first != second)
    first, second, turn, edges = (x[is_curve] for x in (first, second, turn, edges))
    corners = _Corners.of(facet, faces)
    widths = np.stack([_widths(vertices, edges, corners, f) for f in (first, second)], axis=1)
    limited = np.where(np.isfinite(widths) & (widths <= UNEVEN * widths[:, ::-1]), widths, 0.0)
    heights = np.zeros(facet.max() + 1)
    total = limited.sum(1)
    limit = np.where(turn <= SMOOTH, np.inf, UNSEEN * float(np.linalg.norm(np.ptp(vertices[faces], axis=(0, 1)))))
    for f, width in zip((first, second), limited.T, strict=True):
        height = width**2 * turn / np.where(total > 0, 4 * total, 1.0)
        np.maximum.at(heights, f, np.where(height <= limit, height, 0.0))
    heights[smooth_edges >= 3] *= ROUND
    return np.asarray(heights[facet])


def _adjacent(faces: Index) -> tuple[Index, Index, Index]:
    """Pairs of triangles ``(E,)``, ``(E,)`` that share an edge of exactly two, and the edge ``(E, 2)``."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    same = (edges[order][1:] == edges[order][:-1]).all(1)
    start = np.flatnonzero(same & ~np.append(same[1:], False) & ~np.insert(same[:-1], 0, False))
    return order[start] // 3, order[start + 1] // 3, edges[order[start]]


class _Corners(NamedTuple):
    """The vertices of all facets, one facet after another: facet ``f`` has ``number[f]`` from ``start[f]`` on."""

    vertex: Index
    start: Index
    number: Index

    @classmethod
    def of(cls, facet: Index, faces: Index) -> _Corners:
        pairs = np.unique(np.repeat(facet, 3) * (faces.max() + 1) + faces.ravel())
        count = np.bincount(pairs // (faces.max() + 1))
        return cls(pairs % (faces.max() + 1), np.cumsum(count) - count, count)


def _widths(vertices: Array, edges: Index, corners: _Corners, facets: Index) -> Array:
    """Width ``(E,)`` of each facet across its edge ``(E, 2)``; infinite for a plane of many corners."""
    count = np.where(corners.number[facets] > MOST_CORNERS, 1, corners.number[facets])
    begin = np.cumsum(count) - count
    each = np.repeat(np.arange(len(edges)), count)
    those = corners.vertex[corners.start[facets][each] + np.arange(len(each)) - begin[each]]
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    out = vertices[those] - vertices[edges[each, 0]]
    out = out - np.einsum("ki,ki->k", out, along[each])[:, None] * along[each]
    width = np.maximum.reduceat(np.linalg.norm(out, axis=1), begin) if len(each) else np.zeros(0)
    return np.where(corners.number[facets] > MOST_CORNERS, np.inf, width)
