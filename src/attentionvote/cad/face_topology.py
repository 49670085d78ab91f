"""Which faces of a triangle soup belong together: half-edges in pairs, also where more than two faces meet in an edge.

Half-edge ``3 f + i`` runs from corner i of face f to its next corner. A closed surface has a mate for each of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SAME_ANGLE = 1e-6  # rad: faces this near to each other about an edge lie on each other


class Edges(NamedTuple):
    """The edges of a mesh.

    Args:
        of: ``(3 F,)`` the edge of each half-edge.
        ends: ``(E, 2)`` its vertices, the lower one first.
        uses: ``(E,)`` how many faces have it.
        runs_up: ``(3 F,)`` whether the half-edge runs from the lower vertex to the higher.
    """

    of: Ints
    ends: Ints
    uses: Ints
    runs_up: NDArray[np.bool_]


def edges_of(faces: Ints) -> Edges:
    """The edges of ``faces`` ``(F, 3)``."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    count = int(faces.max()) + 1 if len(faces) else 1
    keys, of, uses = np.unique(low * count + high, return_inverse=True, return_counts=True)
    return Edges(of, np.stack([keys // count, keys % count], axis=1), uses, start < end)


def face_labels(mate: Ints) -> Ints:
    """The connected surface ``(F,)`` of each face, numbered in the order of their first faces."""
    here = np.flatnonzero(mate >= 0)
    return _components(here // 3, mate[here] // 3, len(mate) // 3)


def paired(vertices: Array, faces: Ints) -> tuple[Ints, Ints]:
    """Faces of one orientation a surface, and the mate ``(3 F,)`` of each half-edge, -1 where the surface is open.

    Where four faces or more meet in an edge, those that have material between them belong together: solids that touch
    along an edge are two.

    Raises:
        ValueError: when a surface has one side only.
    """
    for _ in range(4):
        edges = edges_of(faces)
        mate = _mates(vertices, faces, edges)
        here = np.flatnonzero(mate >= 0)
        is_same = edges.runs_up[here] == edges.runs_up[mate[here]]
        if not is_same.any():
            return faces, mate
        faces = _turned(faces, here // 3, mate[here] // 3, is_same)
    raise ValueError("a surface with one side only")


def apart(faces: Ints, mate: Ints) -> tuple[Ints, Ints]:
    """Faces whose vertices on edges of four faces or more are copied, one for each surface that passes, and for each
    new vertex ``(V',)`` the one it is a copy of (the first V are their own).
    """
    edges = edges_of(faces)
    count = int(faces.max()) + 1
    is_shared = np.zeros(count, dtype=bool)
    is_shared[edges.ends[edges.uses > 2]] = True
    source = np.arange(count)
    if not is_shared.any():
        return faces, source
    here = np.flatnonzero(mate >= 0)
    fans = _components(
        np.concatenate([here, following(here)]), np.concatenate([following(mate[here]), mate[here]]), len(mate)
    )
    corners = np.flatnonzero(is_shared[faces.ravel()])
    fan, first, which = np.unique(fans[corners], return_index=True, return_inverse=True)
    origin = faces.ravel()[corners[first]]
    # The first fan of a vertex keeps it.
    _, keeps = np.unique(origin, return_index=True)
    number = np.full(len(fan), -1)
    number[keeps] = origin[keeps]
    number[number < 0] = count + np.arange(len(fan) - len(keeps))
    new = faces.ravel().copy()
    new[corners] = number[which]
    is_copy = number >= count
    return new.reshape(-1, 3), np.concatenate([source, origin[is_copy]])


def following(half_edges: Ints) -> Ints:
    """The next half-edge of the same face."""
    return half_edges // 3 * 3 + (half_edges % 3 + 1) % 3


def _components(first: Ints, second: Ints, count: int) -> Ints:
    graph = coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _turned(faces: Ints, first: Ints, second: Ints, is_same: NDArray[np.bool_]) -> Ints:
    """Faces turned so that neighbours agree; of the two ways the one that turns fewer."""
    count = len(faces)
    # Every face stands twice, as it is and turned; two that must agree or differ are joined accordingly.
    crossing = np.where(is_same, count, 0)
    labels = _components(
        np.concatenate([first, first + count]),
        np.concatenate([second + crossing, (second + count + crossing) % (2 * count)]),
        2 * count,
    )
    upright, turned = labels[:count], labels[count:]
    if (upright == turned).any():
        raise ValueError("a surface with one side only")
    kept = np.bincount(upright, minlength=labels.max() + 1)
    is_turned = kept[upright] < kept[turned]
    is_tied = (kept[upright] == kept[turned]) & (upright > turned)
    result = faces.copy()
    result[is_turned | is_tied] = result[is_turned | is_tied, ::-1]
    return result


def _mates(vertices: Array, faces: Ints, edges: Edges) -> Ints:
    mate = np.full(3 * len(faces), -1)
    order = np.argsort(edges.of, kind="stable")
    start = np.concatenate([[0], np.cumsum(edges.uses)])
    two = start[:-1][edges.uses == 2]
    mate[order[two]], mate[order[two + 1]] = order[two + 1], order[two]
    for edge in np.flatnonzero(edges.uses > 2):
        members = order[start[edge] : start[edge + 1]]
        for one, other in _pairs_about(vertices, faces, edges.ends[edge], members, edges.runs_up[members]):
            mate[one], mate[other] = other, one
    return mate


def _pairs_about(
    vertices: Array, faces: Ints, ends: Ints, members: Ints, runs_up: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """The half-edges ``members`` ``(K,)`` of one edge in pairs with material between them; none of an odd number."""
    if len(members) % 2:
        return []
    low, high = vertices[ends]
    axis = (high - low) / np.linalg.norm(high - low)
    arm = vertices[faces[members // 3, (members + 2) % 3]] - low
    arm -= np.outer(arm @ axis, axis)
    across = arm[np.argmax(np.einsum("ni,ni->n", arm, arm))]
    across = across / max(float(np.linalg.norm(across)), 1e-300)
    angle = np.round(np.arctan2(arm @ np.cross(axis, across), arm @ across) / SAME_ANGLE).astype(np.int64)
    angle %= round(2 * np.pi / SAME_ANGLE)
    # A face that runs up has its material at smaller angles, one that runs down at larger ones. On equal angles the
    # former comes first: two solids that touch there, not a sheet.
    order = np.lexsort([~runs_up, angle])
    members, runs_up, angle = members[order], runs_up[order], angle[order]
    if 2 * runs_up.sum() != len(members):
        # Not turned alike yet: neighbours about the edge, in the way that puts less between them.
        gaps = np.diff(angle, append=angle[0] + round(2 * np.pi / SAME_ANGLE))
        shift = int(gaps[::2].sum() > gaps[1::2].sum())
        members = np.roll(members, -shift)
        return list(zip(members[::2], members[1::2], strict=True))
    depth = np.cumsum(np.where(runs_up, -1, 1))
    first = -(int(np.argmin(depth)) + 1)
    waiting: list[int] = []
    pairs = []
    for member, is_up in zip(np.roll(members, first), np.roll(runs_up, first), strict=True):
        if is_up:
            pairs.append((waiting.pop(), int(member)))
        else:
            waiting.append(int(member))
    return pairs
