"""The bodies of a closed surface: which shells are cavities, which solids lie in one another, what stands apart.

A shell is a connected surface, a solid an outer shell with its cavities, a body solids that touch or overlap.
Lengths are shares of the diameter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.cad.hole_filling import LARGEST_MOVE
from attentionvote.cad.surface_distance import SurfaceDistance

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

EMPTY = 1e-6  # of its cubed extent: a shell with less volume encloses nothing
PROBES = 24  # vertices of a shell that tell whether it lies inside of another
GAP_POINTS = 200
MOST_SHELLS = 2000


class Solids(NamedTuple):
    """Shells that were told apart.

    Args:
        faces: ``(F, 3)`` outer shells turned outward, cavities inward; the vertices are those of the surface.
        solid: ``(F,)`` the solid of each face, -1 of shells that enclose nothing.
        turned: how many shells were inside out.
        cavities: how many shells are cavities.
        empty: how many shells enclose nothing.
    """

    faces: Ints
    solid: Ints
    turned: int
    cavities: int
    empty: int


def solids_of(vertices: Array, faces: Ints, shell: Ints) -> Solids:
    """The solids of a closed surface: ``vertices`` ``(V, 3)``, ``faces`` ``(F, 3)``, their shells ``(F,)``.

    A shell inside another is a cavity if it is turned the other way; turned alike it is a solid inside a solid.

    Raises:
        ValueError: when there are more shells than a part has.
    """
    count = int(shell.max()) + 1
    if count > MOST_SHELLS:
        raise ValueError(f"holds {count} separate surfaces, of which a part has at most {MOST_SHELLS}")
    low, high, volume = _measures(vertices, faces, shell, count)
    is_empty = np.abs(volume) <= EMPTY * (high - low).max(axis=1) ** 3
    if count == 1 or is_empty.all():
        is_empty[:] = False
    parent = _parents(vertices, faces, shell, np.where(is_empty, 0.0, volume), low, high)
    solid = np.full(count, -1)
    is_cavity = np.zeros(count, dtype=bool)
    number = 0
    for each in np.argsort(-np.abs(volume), kind="stable"):  # a container comes before what is inside of it
        if is_empty[each]:
            continue
        outer = parent[each]
        if outer >= 0 and not is_cavity[outer] and volume[outer] * volume[each] < 0:
            is_cavity[each], solid[each] = True, solid[outer]
        else:
            solid[each], number = number, number + 1
    # Numbered as the file has them.
    first = np.full(number, count)
    np.minimum.at(first, solid[solid >= 0], np.flatnonzero(solid >= 0))
    solid = np.where(solid >= 0, np.argsort(np.argsort(first))[solid], -1)
    is_turned = ((volume < 0) != is_cavity) & ~is_empty
    result = faces.copy()
    result[is_turned[shell]] = faces[is_turned[shell], ::-1]
    return Solids(result, solid[shell], int(is_turned.sum()), int(is_cavity.sum()), int(is_empty.sum()))


def body_of(vertices: Array, faces: Ints, solid: Ints) -> tuple[Ints, Ints]:
    """The body ``(S,)`` of each solid, and the pairs ``(P, 2)`` of solids that touch.

    Bodies are numbered by volume, the largest first: that does not depend on the file's kind and its reader.
    """
    from manifold3d import OpType

    count = int(solid.max()) + 1
    body = np.arange(count)
    if count == 1:
        return body, np.zeros((0, 2), dtype=np.int64)
    low, high, volume = _measures(vertices, faces[solid >= 0], solid[solid >= 0], count)
    shapes: list[Any] = [None] * count
    pairs = []
    for i in range(count):
        near = np.flatnonzero(((low - LARGEST_MOVE <= high[i]) & (high + LARGEST_MOVE >= low[i])).all(axis=1))
        for j in near[near > i].tolist():
            for each in (i, j):
                if shapes[each] is None:
                    shapes[each] = _manifold(vertices, faces[solid == each])
            one, other = shapes[i], shapes[j]
            is_one = one.min_gap(other, 2 * LARGEST_MOVE) <= LARGEST_MOVE
            if is_one or not one.batch_boolean([one, other], OpType.Intersect).is_empty():
                pairs.append((i, j))
                body[body == body[j]] = body[i]
    label = np.unique(body, return_inverse=True)[1]
    # Copies are as large to the last digits, which rounding may have turned: then by place, along x first.
    share = np.bincount(label, volume)
    middle = np.stack([np.bincount(label, (low + high)[:, i]) / np.bincount(label) for i in range(3)])
    order = np.lexsort([*np.round(middle, 4)[::-1], -np.round(np.log(share), 3)])
    return np.argsort(order)[label], np.array(pairs, dtype=np.int64).reshape(-1, 2)


def united(vertices: Array, faces: Ints, solid: Ints) -> tuple[Array, Ints, float]:
    """Surface of the union of solids, and the volume that was there more than once.

    Raises:
        ValueError: when the solids are none that can be united.
    """
    from manifold3d import Manifold, OpType

    shapes = [_manifold(vertices, faces[solid == each]) for each in np.unique(solid[solid >= 0])]
    union = Manifold.batch_boolean(shapes, OpType.Add)
    twice = sum(shape.volume() for shape in shapes) - union.volume()
    mesh = union.to_mesh64()
    points = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    return points, np.asarray(mesh.tri_verts, dtype=np.int64), float(twice)


def gap(vertices: Array, faces: Ints, other: Ints) -> float:
    """Distance between two surfaces that do not touch, for people: from the vertices that look nearest, of each."""
    one, two = (vertices[np.unique(each)] for each in (faces, other))
    near = one[np.argsort(cKDTree(two).query(one)[0])[:GAP_POINTS]]
    far = two[np.argsort(cKDTree(one).query(two)[0])[:GAP_POINTS]]
    to_other, to_one = SurfaceDistance(vertices, other)(near), SurfaceDistance(vertices, faces)(far)
    return float(min(to_other.min(), to_one.min()))


def inside(points: Array, vertices: Array, faces: Ints) -> NDArray[np.bool_]:
    """Whether each of ``points`` ``(N, 3)`` is inside of a closed surface, whichever way that is turned."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    result = np.zeros(len(points), dtype=bool)
    for i, point in enumerate(points):
        p, q, r = a - point, b - point, c - point
        x, y, z = (np.sqrt(np.einsum("ni,ni->n", v, v)) for v in (p, q, r))
        below = x * y * z + np.einsum("ni,ni->n", p, q) * z
        below += np.einsum("ni,ni->n", q, r) * x + np.einsum("ni,ni->n", r, p) * y
        angle = 2 * np.arctan2(np.einsum("ni,ni->n", p, np.cross(q, r)), below).sum()
        result[i] = abs(angle) > 2 * np.pi
    return result


def _measures(vertices: Array, faces: Ints, label: Ints, count: int) -> tuple[Array, Array, Array]:
    """Lowest and highest corner ``(count, 3)`` and signed volume ``(count,)`` of each shell."""
    order = np.argsort(label, kind="stable")
    corners = vertices[faces[order]]
    start = np.searchsorted(label[order], np.arange(count))
    low = np.minimum.reduceat(corners.min(axis=1), start)
    high = np.maximum.reduceat(corners.max(axis=1), start)
    local = corners - ((low + high) / 2)[label[order]][:, None]
    cross = np.cross(local[:, 1], local[:, 2])
    return low, high, np.bincount(label[order], np.einsum("ni,ni->n", local[:, 0], cross), count) / 6


def _parents(vertices: Array, faces: Ints, shell: Ints, volume: Array, low: Array, high: Array) -> Ints:
    """The smallest shell that each shell ``(S,)`` lies in, -1 for none; shells of no volume take no part."""
    count = len(volume)
    parent = np.full(count, -1)
    order = np.argsort(shell, kind="stable")
    bounds = np.searchsorted(shell[order], np.arange(count + 1))
    for each in np.flatnonzero(volume):
        larger = np.flatnonzero(
            (np.abs(volume) > abs(volume[each])) & (low < low[each]).all(axis=1) & (high > high[each]).all(axis=1)
        )
        if not len(larger):
            continue
        own = np.unique(faces[order[bounds[each] : bounds[each + 1]]])
        probes = vertices[own[np.linspace(0, len(own) - 1, min(PROBES, len(own))).astype(np.int64)]]
        for outer in larger[np.argsort(np.abs(volume[larger]))]:
            if inside(probes, vertices, faces[order[bounds[outer] : bounds[outer + 1]]]).all():
                parent[each] = outer
                break
    return parent


def _manifold(vertices: Array, faces: Ints) -> Any:
    from manifold3d import Error, Manifold, Mesh64

    used, compact = np.unique(faces, return_inverse=True)
    shape = Manifold(Mesh64(np.ascontiguousarray(vertices[used]), compact.reshape(-1, 3).astype(np.uint64)))
    if shape.status() != Error.NoError:
        raise ValueError(f"holds a solid that cannot be united with others ({shape.status()})")
    return shape
