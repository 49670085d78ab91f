"""A surface as a file has it, made whole: one vertex for each place, two faces for each edge, no holes.

Everything is measured in shares of the diameter D, so that a part is treated alike in any unit and size.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.face_topology import apart, edges_of, face_labels, paired
from attentionvote.cad.hole_filling import lids
from attentionvote.cad.vertex_merging import ZIPPED, distinct, merged, zipped

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_LEAVES = 12  # patches of a surface that are tried as walls inside or fins outside


class CannotHeal(ValueError):
    """A surface that would have to be invented.

    Args:
        message: what is wrong, to be put behind the file's name.
        where: ``(N, 2, 3)`` lines to look at, in shares of D; ``metres`` the same in the file's frame, once known.
    """

    def __init__(self, message: str, where: Array) -> None:
        super().__init__(message)
        self.where = where
        self.metres: Array | None = None


@dataclass
class Changes:
    """What was done to a surface.

    Args:
        notes: what, for people.
        moved: how far the surface went, a share of D.
        removed: ``(R, 3, 3)`` triangles left out, which must be inside of what is left, or on it.
        where: ``(N, 2, 3)`` lines at the largest move, as far as they are known.
    """

    notes: list[str] = field(default_factory=list)
    moved: float = 0.0
    removed: list[Array] = field(default_factory=list)
    where: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))

    def note(self, text: str, moved: float = 0.0, where: Array | None = None) -> None:
        """Add what was done, how far it moved the surface, and where."""
        self.notes.append(text)
        if moved > self.moved and where is not None:
            self.where = where
        self.moved = max(self.moved, moved)


class Whole(NamedTuple):
    """A closed surface.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``, neighbours of one orientation; where surfaces touch each has vertices of its own.
        source: ``(V,)`` the vertex that each is a copy of.
        shell: ``(F,)`` the connected surface of each face.
    """

    vertices: Array
    faces: Ints
    source: Ints
    shell: Ints


def healed(vertices: Array, faces: Ints, changes: Changes, length: float) -> Whole:
    """The surface of ``vertices`` ``(V, 3)`` in shares of D and ``faces`` ``(F, 3)``, closed.

    Args:
        vertices, faces: as the file has them.
        changes: is added to.
        length: D in millimetres, for the words.

    Raises:
        CannotHeal: where a surface is missing that cannot be told from what is around it.
    """
    stand, moved, count = merged(vertices)
    faces = stand[faces]
    if count:
        lines = np.stack([vertices, vertices[stand]], axis=1)
        far = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) > moved / 2
        changes.note(
            f"merged {counted(count, 'vertex', 'vertices')} up to {_short(moved * length)} apart", moved, lines[far]
        )
    faces = _without_copies(vertices, faces, changes)
    vertices, faces = _zip_cracks(vertices, faces, changes, length)
    whole = faces
    faces = _without_leaves(vertices, faces, changes)
    if len(faces) < 4:
        raise CannotHeal("encloses nothing: walls and fins are all there is", vertices[whole[:, :2]])
    vertices, faces, mate = _close(vertices, faces, changes)
    return _whole(vertices, faces, mate)


def settled(vertices: Array, faces: Ints) -> Whole:
    """A surface that is closed already, after something joined or cut it: merged again, and paired again."""
    stand, _, _ = merged(vertices)
    faces = distinct(stand[faces]).faces
    faces, mate = paired(vertices, faces)
    if (mate < 0).any():
        raise CannotHeal("the united surface is not closed", _lines(vertices, faces, mate))
    return _whole(vertices, faces, mate)


def _without_copies(vertices: Array, faces: Ints, changes: Changes) -> Ints:
    result = distinct(faces)
    if result.repeated:
        changes.note(f"left out {counted(result.repeated, 'copy', 'copies')} of faces")
    if len(result.removed):
        changes.note(f"left out {counted(len(result.removed), 'pair', 'pairs')} of opposite faces")
        changes.removed.append(vertices[result.removed])
    if len(result.faces) < 4:
        raise CannotHeal(f"encloses nothing: {len(result.faces)} faces are left", vertices[faces[:, :2]])
    return result.faces


def _zip_cracks(vertices: Array, faces: Ints, changes: Changes, length: float) -> tuple[Array, Ints]:
    for tolerance in ZIPPED:
        before = int((edges_of(faces).uses == 1).sum())
        if not before:
            break
        new_vertices, new_faces, moved = zipped(vertices, faces, tolerance)
        new_faces = distinct(new_faces).faces
        if not moved or len(new_faces) < 4:
            continue
        after = edges_of(new_faces).uses
        if (after == 1).sum() < before and (after > 2).sum() <= (edges_of(faces).uses > 2).sum():
            closed = before - int((after == 1).sum())
            changes.note(f"joined {closed} open edges up to {_short(2 * moved * length)} apart", moved)
            vertices, faces = new_vertices, new_faces
    return vertices, faces


def _without_leaves(vertices: Array, faces: Ints, changes: Changes) -> Ints:
    """Without walls inside and fins outside: surfaces of two sides, on edges of an odd number of faces."""
    for _ in range(MOST_LEAVES):
        edges = edges_of(faces)
        if not (edges.uses[edges.uses > 2] % 2).any():
            return faces
        order = np.argsort(edges.of, kind="stable")
        start = np.cumsum(edges.uses) - edges.uses
        two = start[edges.uses == 2]
        mate = np.full(3 * len(faces), -1)
        mate[order[two]], mate[order[two + 1]] = order[two + 1], order[two]
        patch = face_labels(mate)
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        areas = np.bincount(patch, area)
        rim = edges.uses[edges.of]
        rim_patch = np.repeat(patch, 3)
        is_even = np.bincount(rim_patch, (rim > 2) & (rim % 2 == 0), len(areas)) > 0
        is_leaf = ~is_even & (np.bincount(rim_patch, (rim > 2) & (rim % 2 == 1), len(areas)) > 0)
        if not is_leaf.any():
            return faces
        smallest = np.argmin(np.where(is_leaf, areas, np.inf))
        gone = patch == smallest
        changes.note(f"left out a wall of {int(gone.sum())} faces")
        changes.removed.append(vertices[faces[gone]])
        faces = faces[~gone]
    return faces


def _close(vertices: Array, faces: Ints, changes: Changes) -> tuple[Array, Ints, Ints]:
    opened = holes = 0
    off = 0.0
    turned = 0
    for _ in range(4):
        before = faces
        try:
            faces, mate = paired(vertices, faces)
        except ValueError as error:
            raise CannotHeal("has a surface with one side only", vertices[faces[:, :2]]) from error
        turned += int((faces[:, 0] != before[:, 0]).sum())
        is_open = mate < 0
        if not is_open.any():
            break
        opened = max(opened, int(is_open.sum()))
        if is_open.sum() > 0.2 * len(mate):
            count = int(is_open.sum())
            raise CannotHeal(f"is a sheet and no solid: {count} of its edges are open", _lines(vertices, faces, mate))
        result = lids(vertices, faces, mate)
        if len(result.refused) and (stray := _stray_sheets(vertices, faces, mate, result.refused)).any():
            changes.note(f"left out {counted(int(stray.sum()), 'face', 'faces')} of open sheets")
            changes.removed.append(vertices[faces[stray]])
            faces = faces[~stray]
            continue
        if len(result.refused) or not result.holes:
            lines = vertices[result.refused] if len(result.refused) else _lines(vertices, faces, mate)
            many = int((edges_of(faces).uses > 2).sum())
            raise CannotHeal(
                f"must be watertight, got {len(lines)} open edges about holes too large or too crooked to close and "
                f"{many} edges of more than two faces",
                lines,
            )
        faces = np.concatenate([faces, result.faces])
        holes += result.holes
        off = max(off, result.uncertainty)
    else:
        raise CannotHeal("must be watertight, got edges that no lid closes", _lines(vertices, faces, mate))
    if turned:
        changes.note(f"turned {counted(turned, 'face', 'faces')}")
    if holes:
        changes.note(f"closed {counted(holes, 'hole', 'holes')} ({opened} open edges)", off)
    return vertices, faces, mate


def _stray_sheets(vertices: Array, faces: Ints, mate: Ints, rim: Ints) -> NDArray[np.bool_]:
    """The faces ``(F,)`` of surfaces that cannot be closed, beside larger ones that can."""
    label = face_labels(mate)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    starts = faces.ravel()[np.flatnonzero(mate < 0)]
    is_bad = np.isin(label, label[np.flatnonzero(mate < 0)[np.isin(starts, rim)] // 3])
    area = np.linalg.norm(normal, axis=1)
    return is_bad if area[is_bad].sum() < area[~is_bad].sum() else np.zeros(len(faces), dtype=bool)


def _whole(vertices: Array, faces: Ints, mate: Ints) -> Whole:
    faces, source = apart(faces, mate)
    return Whole(vertices[source], faces, source, face_labels(mate))


def _lines(vertices: Array, faces: Ints, mate: Ints) -> Array:
    half = np.flatnonzero(mate < 0)
    return vertices[np.stack([faces.ravel()[half], np.roll(faces, -1, axis=1).ravel()[half]], axis=1)]


def counted(count: int, one: str, many: str) -> str:
    """A number with its noun."""
    return f"{count} {one if count == 1 else many}"


def _short(millimetres: float) -> str:
    """A length for people: micrometres below a hundredth of a millimetre."""
    return f"{millimetres * 1000:.2g} um" if millimetres < 0.01 else f"{millimetres:.2g} mm"
