"""Lids on the small holes of a surface, and on the cracks where one side has more vertices than the other.

Lengths are shares of the diameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.face_topology import edges_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LARGEST_MOVE = 5e-4  # of the diameter: how far the surface may lie from the file's
SMALL = 0.1  # a hole this narrow is closed whatever is around it; a wider one if its lid goes on as its surroundings do
SLIT = 0.2  # width over length of a round from which it may be the end of a tube
GOES_ON = np.cos(np.radians(10.0))
EXACT_CORNERS = 40  # the best lid is searched for up to this many corners


class Lids(NamedTuple):
    """What closes a surface.

    Args:
        faces: ``(L, 3)`` new faces.
        holes: how many holes they close.
        uncertainty: the most that the true surface may lie from a lid, by how far its rim is from flat.
        refused: ``(N, 2)`` open edges that nothing closes.
    """

    faces: Ints
    holes: int
    uncertainty: float
    refused: Ints


def lids(vertices: Array, faces: Ints, mate: Ints) -> Lids:
    """Lids for the holes of ``faces`` ``(F, 3)`` whose half-edges have the mates ``mate`` ``(3 F,)``."""
    edges = edges_of(faces)
    count = len(vertices)
    known = set((edges.ends[:, 0] * count + edges.ends[:, 1]).tolist())
    made: list[Ints] = []
    refused: list[Ints] = []
    uncertainty = 0.0
    loops = _loops(faces, mate)
    ends = _ends_of_tubes(vertices, faces, loops)
    for number, loop in enumerate(loops):
        corners = faces.ravel()[loop]
        rim = np.stack([corners, np.roll(corners, -1)], axis=1)
        lid, off = (None, 0.0) if number in ends else _lid(vertices, faces, loop, known)
        if lid is None:
            refused.append(rim)
            continue
        made.append(lid)
        low, high = np.sort(np.concatenate([lid[:, [0, 1]], lid[:, [1, 2]], lid[:, [2, 0]]]), axis=1).T
        known.update((low * count + high).tolist())
        uncertainty = max(uncertainty, off)
    none: Ints = np.zeros((0, 3), dtype=np.int64)
    return Lids(
        np.concatenate([none, *made]), len(made), uncertainty, np.concatenate([none[:, :2], *refused])
    )  # fmt: skip


def _loops(faces: Ints, mate: Ints) -> list[list[int]]:
    """The open half-edges in closed rounds that pass no vertex twice."""
    mates = dict(zip(*(x.tolist() for x in _near_open(faces, mate)), strict=True))
    start_of = faces.ravel()
    waiting = dict.fromkeys(np.flatnonzero(mate < 0).tolist())
    loops = []
    while waiting:
        path: list[int] = []
        place: dict[int, int] = {}
        here = next(iter(waiting))
        while here in waiting:
            del waiting[here]
            vertex = int(start_of[here])
            if vertex in place:  # a figure of eight: the round that is closed here is a hole of its own
                loops.append(path[place[vertex] :])
                for each in path[place[vertex] :]:
                    place.pop(int(start_of[each]), None)
                path = path[: len(path) - len(loops[-1])]
            place[vertex] = len(path)
            path.append(here)
            # On to the next open half-edge about the end of this one, within the surface.
            here = _after(here)
            while mates[here] >= 0:
                here = _after(mates[here])
        if path:
            loops.append(path)
    return [loop for loop in loops if len(loop) > 2]


def _ends_of_tubes(vertices: Array, faces: Ints, loops: list[list[int]]) -> set[int]:
    """Rounds that face another one of the same outline, the two ends of a bore or tube whose wall is missing, and those
    within another one in its plane, where a ring is missing: a lid would close what was meant to be open."""
    start_of = faces.ravel()
    shapes = []
    for number, loop in enumerate(loops):
        points = vertices[start_of[loop]]
        middle = points.mean(axis=0)
        spread = np.linalg.svd(points - middle, full_matrices=False)
        widths = np.ptp((points - middle) @ spread.Vh[:2].T, axis=0)
        if len(loop) > 4 and widths.min() > SLIT * widths.max():
            shapes.append((number, middle, spread.Vh[2], float(widths.max())))
    found = set()
    for i, (a, middle, normal, width) in enumerate(shapes):
        for b, other, other_normal, other_width in shapes[:i]:
            between = other - middle
            along = float(between @ normal)
            beside = float(np.linalg.norm(between - along * normal))
            is_coaxial = abs(normal @ other_normal) > GOES_ON and beside < 0.1 * min(width, other_width)
            is_alike = abs(width - other_width) < 0.05 * max(width, other_width)
            if is_coaxial and (is_alike or abs(along) < 0.05 * min(width, other_width)):
                found |= {a, b}
    return found


def _after(half_edge: int) -> int:
    return half_edge // 3 * 3 + (half_edge + 1) % 3


def _near_open(faces: Ints, mate: Ints) -> tuple[Ints, Ints]:
    """The half-edges of all faces with a vertex on an open edge, and their mates."""
    is_rim = np.zeros(int(faces.max()) + 1, dtype=bool)
    is_open = mate < 0
    is_rim[faces.ravel()[is_open]] = True
    is_rim[np.roll(faces, -1, axis=1).ravel()[is_open]] = True
    near = np.flatnonzero(np.repeat(is_rim[faces].any(axis=1), 3))
    return near, mate[near]


def _lid(vertices: Array, faces: Ints, loop: list[int], known: set[int]) -> tuple[Ints | None, float]:
    """Faces that close a round of open half-edges, and how far its rim is from flat; None if they would be invented."""
    corners = faces.ravel()[loop][::-1]  # a lid runs against the rim
    points = vertices[corners]
    middle = points - points.mean(axis=0)
    normal = np.cross(middle, np.roll(middle, -1, axis=0)).sum(axis=0)
    length = float(np.linalg.norm(normal))
    spread = np.linalg.svd(middle, full_matrices=False)
    normal = spread.Vh[2] if length < 1e-12 else normal / length
    height = middle @ normal
    off = 0.0 if len(points) == 3 else float(np.ptp(height)) / 2
    if off > LARGEST_MOVE:
        return None, off
    flat = middle - np.outer(height, normal)
    along = flat @ spread.Vh[:2].T
    widths = np.ptp(along, axis=0)
    if len(points) > 3 and widths.min() > SMALL and not _goes_on(vertices, faces, loop, normal):
        return None, off
    if len(corners) == 3:
        return corners[None], off
    if len(corners) <= EXACT_CORNERS:
        lid = _best_lid(points, corners, known, len(vertices))
    else:
        lid = _flat_lid(flat, normal, corners, known, len(vertices))
    return lid, off


def _goes_on(vertices: Array, faces: Ints, loop: list[int], normal: Array) -> bool:
    """Whether a lid of this normal continues the faces about it along a third of its rim or more."""
    a, b, c = (vertices[faces[np.asarray(loop) // 3, i]] for i in range(3))
    around = np.cross(b - a, c - a)
    size = np.linalg.norm(around, axis=1)
    # The rim is walked backwards for the lid, so that lid and surface have one orientation.
    is_on = around @ normal > GOES_ON * size
    ends = faces.ravel()[loop]
    rim = np.linalg.norm(vertices[ends] - vertices[np.roll(ends, -1)], axis=1)
    return bool(rim[is_on].sum() >= rim.sum() / 3)


def _best_lid(points: Array, corners: Ints, known: set[int], count: int) -> Ints | None:
    """The triangulation of least area (and, of equal ones, of short chords) without an edge that exists already."""
    n = len(points)
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    low, high = np.minimum(corners[:, None], corners), np.maximum(corners[:, None], corners)
    barred = np.array([key in known for key in (low * count + high).ravel().tolist()]).reshape(n, n)
    step = np.abs(np.arange(n)[:, None] - np.arange(n))
    chord = np.where(barred & (step > 1) & (step < n - 1), np.inf, 1e-3 * distance**2)
    best = np.zeros((n, n))
    split = np.zeros((n, n), dtype=np.int64)
    for width in range(2, n):
        for i in range(n - width):
            j = i + width
            k = np.arange(i + 1, j)
            area = np.linalg.norm(np.cross(points[k] - points[i], points[j] - points[i]), axis=1) / 2
            cost = best[i, k] + best[k, j] + area + chord[i, j]
            split[i, j] = k[np.argmin(cost)]
            best[i, j] = cost.min()
    if not np.isfinite(best[0, n - 1]):
        return None
    stack, result = [(0, n - 1)], []
    while stack:
        i, j = stack.pop()
        if j - i > 1:
            middle = int(split[i, j])
            result.append((i, middle, j))
            stack += [(i, middle), (middle, j)]
    return corners[np.array(result)]


def _flat_lid(flat: Array, normal: Array, corners: Ints, known: set[int], count: int) -> Ints | None:
    from manifold3d import triangulate

    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    plane = np.stack([flat @ across, flat @ np.cross(normal, across)], axis=1)
    lid = corners[np.asarray(triangulate([plane], 1e-9), dtype=np.int64)]
    rim = np.sort(np.stack([corners, np.roll(corners, -1)], axis=1), axis=1)
    ends = np.sort(np.concatenate([lid[:, [0, 1]], lid[:, [1, 2]], lid[:, [2, 0]]]), axis=1)
    chords = np.unique(ends[:, 0] * count + ends[:, 1])
    chords = np.setdiff1d(chords, rim[:, 0] * count + rim[:, 1])
    is_whole = len(lid) == len(corners) - 2 and not known.intersection(chords.tolist())
    return lid if is_whole else None
