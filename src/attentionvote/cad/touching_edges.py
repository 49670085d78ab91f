"""Surfaces that touch along an edge, told apart as a file can say it: both are moved a little into their material.

Lengths are shares of the diameter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.face_topology import edges_of, paired
from attentionvote.cad.healing import Whole

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SET_APART = 2e-5


def set_apart(whole: Whole) -> tuple[Array, Ints, int]:
    """Vertices and faces of which no two surfaces share a place, by moving both into their material; how many edges.

    A file has no other way to say that two edges in one place are two.
    """
    source, faces = whole.source, whole.faces
    edges = edges_of(source[faces])
    touching = int((edges.uses > 2).sum())
    if not touching:
        used, compact = np.unique(faces, return_inverse=True)
        return whole.vertices[used], compact.reshape(-1, 3), 0
    copies = np.bincount(source, minlength=len(source))
    moved = np.flatnonzero(copies[source] > 1)
    vertices = whole.vertices.copy()
    vertices[moved] -= SET_APART * _outward(vertices, faces)[moved]
    vertices, faces = _split_pinched(vertices, faces)
    used, compact = np.unique(faces, return_inverse=True)
    return vertices[used], compact.reshape(-1, 3), touching


def _outward(vertices: Array, faces: Ints) -> Array:
    """Unit normals ``(V, 3)``, each face weighted by its angle there; zero where there is no face."""
    result = np.zeros_like(vertices)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(size > 0, size, 1.0)
    for i in range(3):
        one, other = (corners[:, (i + k) % 3] - corners[:, i] for k in (1, 2))
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.einsum("ni,ni->n", one, other))
        np.add.at(result, faces[:, i], normal * angle[:, None])
    size = np.linalg.norm(result, axis=1, keepdims=True)
    return result / np.where(size > 1e-9, size, 1.0)


def _split_pinched(vertices: Array, faces: Ints) -> tuple[Array, Ints]:
    """An edge of four faces between vertices that all of them share: a vertex in its middle for each pair."""
    edges = edges_of(faces)
    if not (edges.uses > 2).any():
        return vertices, faces
    faces, mate = paired(vertices, faces)
    edges = edges_of(faces)
    first = np.flatnonzero((edges.uses[edges.of] > 2) & (np.arange(len(mate)) < mate))
    done: set[int] = set()
    added: list[Array] = []
    extra: list[tuple[int, int, int]] = []
    gone: list[int] = []
    for one in first.tolist():
        other = int(mate[one])
        if one // 3 in done or other // 3 in done:
            continue
        done |= {one // 3, other // 3}
        a, b = (faces.ravel()[h] for h in (one, other))
        corners = vertices[faces[[one // 3, other // 3]]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        middle = len(vertices) + len(added)
        added.append((vertices[a] + vertices[b]) / 2 - SET_APART * normal)
        for half in (one, other):
            f, i = divmod(half, 3)
            p, q, r = (int(faces[f, (i + k) % 3]) for k in range(3))
            gone.append(f)
            extra += [(p, middle, r), (middle, q, r)]
    if not added:
        return vertices, faces
    faces = np.concatenate([np.delete(faces, gone, axis=0), np.array(extra, dtype=np.int64)])
    return _split_pinched(np.concatenate([vertices, np.array(added)]), faces)
