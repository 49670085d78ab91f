"""Vertices that are one but for rounding, and faces that are there twice or not at all.

Lengths are shares of the diameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from attentionvote.cad.face_topology import edges_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MERGED = 1e-5  # vertices nearer than this are one
ZIPPED = (5e-5, 2e-4, 4.5e-4)  # vertices of open edges nearer than this are one, the nearest first
MOSTLY_CLOSED = 0.1  # share of open edges up to which a surface that is there twice is a body


class Distinct(NamedTuple):
    """Faces without what is there twice.

    Args:
        faces: ``(F, 3)`` those that stay.
        repeated: number of copies of the same face left out.
        removed: ``(R, 3)`` faces left out in pairs of opposite orientation: nothing is between them.
    """

    faces: Ints
    repeated: int
    removed: Ints


def merged(vertices: Array, tolerance: float = MERGED) -> tuple[Ints, float, int]:
    """For each vertex ``(V,)`` the one that stands for it, the largest distance between the two, and how many moved."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    is_new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    stand = np.empty(len(vertices), dtype=np.int64)
    # lexsort is stable: the first of equals is the first of the file.
    stand[order] = order[np.flatnonzero(is_new)][np.cumsum(is_new) - 1]
    single = np.sort(order[is_new])
    pairs = cKDTree(vertices[single]).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return stand, 0.0, 0
    first = _first_of_cluster(pairs, len(single))
    moved = np.linalg.norm(vertices[single] - vertices[single[first]], axis=1)
    new = np.arange(len(vertices))
    new[single] = single[first]
    return new[stand], float(moved.max()), int((moved > 0).sum())


def zipped(vertices: Array, faces: Ints, tolerance: float) -> tuple[Array, Ints, float]:
    """Vertices and faces with the vertices of open edges joined across cracks, and the largest move.

    Neighbours along an open edge are not across it.
    """
    edges = edges_of(faces)
    is_open = edges.uses == 1
    rim = np.unique(edges.ends[is_open])
    pairs = cKDTree(vertices[rim]).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return vertices, faces, 0.0
    count = len(vertices)
    ends = np.sort(rim[pairs], axis=1)
    joined = np.isin(ends @ [count, 1], edges.ends @ [count, 1])
    pairs = pairs[~joined]
    if not len(pairs):
        return vertices, faces, 0.0
    first = _first_of_cluster(pairs, len(rim))
    weight = np.bincount(first, minlength=len(rim))
    total = np.stack([np.bincount(first, vertices[rim, i], len(rim)) for i in range(3)], axis=1)
    middle: Array = total[first] / weight[first, None]
    moves = float(np.linalg.norm(vertices[rim] - middle, axis=1).max(initial=0.0))
    vertices = vertices.copy()
    vertices[rim] = middle
    stand = np.arange(count)
    stand[rim] = rim[first]
    return vertices, stand[faces], moves


def distinct(faces: Ints) -> Distinct:
    """``faces`` ``(F, 3)`` without those of two corners, copies, and pairs of opposite orientation.

    A face of two corners has its two neighbours on the same edge: leaving it out opens nothing, and neither does
    leaving out an opposite pair. A body of which every face is there from both sides is kept once.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    ordered = np.sort(faces, axis=1)
    count = int(faces.max()) + 1 if len(faces) else 1
    keys = (ordered[:, 0] * count + ordered[:, 1]) * count + ordered[:, 2] if count < 2**21 else _row_keys(ordered)
    _, first, of, uses = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    if (uses == 1).all():
        return Distinct(faces, 0, faces[:0])
    rolled = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    sign = np.where(rolled[:, 1] < rolled[:, 2], 1, -1)
    net = np.rint(np.bincount(of, sign)).astype(np.int64)
    is_pair = net == 0
    is_kept = ~is_pair
    if is_pair.any():
        is_kept |= _bodies_there_twice(faces[first], is_pair)
    # The copy that is kept is the first one that runs as most of them do.
    fits = (sign == np.sign(net)[of]) | (net[of] == 0)
    candidates = np.flatnonzero(fits)
    _, earliest = np.unique(of[candidates], return_index=True)
    chosen = np.sort(candidates[earliest][is_kept])
    repeated = int((uses - 1)[is_kept].sum())
    return Distinct(faces[chosen], repeated, faces[first[~is_kept]])


def _bodies_there_twice(faces: Ints, is_pair: NDArray[np.bool_]) -> NDArray[np.bool_]:
    edges = edges_of(faces)
    face = np.repeat(np.arange(len(faces)), 3)
    graph = coo_matrix((np.ones(len(face)), (face, len(faces) + edges.of)), shape=(len(faces) + len(edges.uses),) * 2)
    body = connected_components(graph, directed=False)[1][: len(faces)]
    is_double = np.bincount(body, ~is_pair) == 0
    opened = np.bincount(body[face], edges.uses[edges.of] != 2)
    is_double &= opened <= MOSTLY_CLOSED * np.bincount(body[face])
    return np.asarray(is_double[body])


def _row_keys(rows: Ints) -> Ints:
    return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1], dtype=np.int64)


def _first_of_cluster(pairs: Ints, count: int) -> Ints:
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), tuple(pairs.T)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    return np.asarray(first[label], dtype=np.int64)
