"""A part from whatever file its owner has: read, healed, told apart from other bodies, and what was done to it.

``mesh_file.load_surface`` reads the result again, and refuses what is not whole; nothing is healed there.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.assembly import as_one, assembly_question, listed, told_apart
from attentionvote.cad.bodies import EMPTY, inside
from attentionvote.cad.healing import CannotHeal, Changes, counted, healed
from attentionvote.cad.hole_filling import LARGEST_MOVE
from attentionvote.cad.mesh_file import (
    FORMATS,
    METRES_PER_UNIT,
    SMALLEST_EXTENT,
    check_size,
    largest_vertex_distance,
    load_surface,
    read_mesh,
)
from attentionvote.cad.step_file import STEP_FORMATS, read_step
from attentionvote.cad.surface_distance import SurfaceDistance
from attentionvote.cad.touching_edges import SET_APART, set_apart
from attentionvote.cad.vertex_merging import merged
from attentionvote.part import uniform_points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NOTHING = "nothing to heal"
ALL = 0  # as the body: all of them are one part
REMOVED_POINTS = 200


class ImportedPart(NamedTuple):
    """A part's surface.

    Args:
        vertices: ``(V, 3)`` metres, in the file's frame.
        faces: ``(F, 3)`` outward.
        report: what was healed, one line.
        moved: how far the surface went, metres.
        bodies: sizes of the bodies in the file, one for each.
        source: the file, and the unit it was read in.
    """

    vertices: Array
    faces: Ints
    report: str
    moved: float
    bodies: list[str]
    source: str = ""

    @property
    def line(self) -> str:
        """Which file, what was done to it, and how far that moved the surface."""
        moved = f"; the surface moved by {self.moved * 1e6:.2g} um at most" if self.moved >= 1e-9 else ""
        return f"{self.source}: {self.report}{moved}"


def import_part(
    path: str | Path, units: str | None = None, body: int | None = None, picture: Path | None = None
) -> ImportedPart:
    """The surface of a part from a STEP, STL, OBJ, PLY or GLB file.

    Args:
        path: the file.
        units: m, cm, mm or inch; None = what the file says, metres if it does not.
        body: which body of an assembly, from 1; 0 = all of them are one part; None = there must be one.
        picture: where a PNG goes that shows what cannot be healed; None = nowhere.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: with one sentence, when it is no readable, finite solid of plausible size, when it cannot be made
            whole without moving the surface by more than 0.05 % of its diameter, or when it is an assembly.
    """
    path = Path(path)
    vertices, faces = _read(path, units)
    try:
        result = _imported(vertices, faces, path.name, body)
        if body and len(result.bodies) > 1 and path.suffix.lower() in STEP_FORMATS:
            # Cut anew for the size of this body: the assembly's chords may be coarse for it.
            diameter = largest_vertex_distance(result.vertices)
            vertices, faces = read_step(path, units, diameter)
            result = _imported(vertices, faces, path.name, body, result.vertices)
    except CannotHeal as error:
        raise ValueError(_refusal(error, path.name, vertices, faces, picture)) from error
    if picture is not None:
        picture.unlink(missing_ok=True)  # of an attempt before
    is_step = path.suffix.lower() in STEP_FORMATS
    if result.report == NOTHING and len(result.bodies) == 1 and not is_step:
        # What was whole already comes as the strict reader has it, so that a part made before is the same part again.
        strict, triangles = load_surface(path, units or "m")
        if len(triangles) == len(result.faces):
            result = result._replace(vertices=strict, faces=triangles)
    return result._replace(source=path.name if is_step else f"{path.name} in {units or 'm'}")


def _corners_of(vertices: Array, faces: Ints) -> Array:
    """The vertices ``(U, 3)`` that faces have: some files hold others."""
    is_used = np.zeros(len(vertices), dtype=bool)
    is_used[faces] = True
    return vertices[is_used]


def _read(path: Path, units: str | None) -> tuple[Array, Ints]:
    if units is not None and units not in METRES_PER_UNIT:
        raise ValueError(f"units must be one of {', '.join(METRES_PER_UNIT)}, got {units!r}")
    suffix = path.suffix.lower()
    if suffix not in (*STEP_FORMATS, *FORMATS):
        raise ValueError(f"mesh file must end in one of {', '.join((*STEP_FORMATS, *FORMATS))}, got '{path.name}'")
    if not path.is_file():
        raise FileNotFoundError(f"mesh file '{path}' does not exist")
    if suffix in STEP_FORMATS:
        vertices, faces = read_step(path, units)
    else:
        mesh = read_mesh(path)
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * METRES_PER_UNIT[units or "m"]
        faces = np.asarray(mesh.faces, dtype=np.int64)
    bad = int((~np.isfinite(vertices)).sum())
    if bad:
        raise ValueError(f"mesh '{path.name}' must have finite vertices, got {bad} NaN or inf")
    used = _corners_of(vertices, faces)
    check_size(used.max(axis=0) - used.min(axis=0), units or "m", path.name)
    return vertices, faces


def _imported(vertices: Array, faces: Ints, name: str, body: int | None, near: Array | None = None) -> ImportedPart:
    """The part in metres; works on it in shares of its diameter, about its middle.

    Given the corners ``near`` ``(N, 3)`` of a body, that one is taken, whatever its number is by now.
    """
    used = _corners_of(vertices, faces)
    diameter = largest_vertex_distance(used)
    centre = (used.max(axis=0) + used.min(axis=0)) / 2
    changes = Changes()
    try:
        whole = healed((vertices - centre) / diameter, faces, changes, diameter * 1000)
        split = told_apart(whole, changes, diameter)
        count = len(split.sizes)
        if body is not None and not 0 <= body <= count:
            raise ValueError(f"mesh '{name}' has no BODY={body}, got {listed(split.sizes)}")
        if body is None and count > 1:
            raise ValueError(f"mesh '{name}' {assembly_question(split, diameter)}")
        if body and count > 1:
            # Again from the file's own triangles: what is a rounding in the whole may be a feature of this body.
            chosen = body - 1
            if near is not None:
                boxes = [_box(split.vertices[split.faces[split.body == k]].reshape(-1, 3)) for k in range(count)]
                away = [np.abs(box - (_box(near) - centre) / diameter).max() for box in boxes]
                chosen = int(np.argmin(away))
            stand = merged((vertices - centre) / diameter)[0]
            is_there = np.isin(np.arange(len(vertices)), whole.source[split.faces[split.body == chosen]])
            result = _imported(vertices, faces[is_there[stand[faces]].any(axis=1)], name, ALL)
            report = f"body {body} of {count}" + (f"; {result.report}" if result.report != NOTHING else "")
            largest = float(np.ptp(result.vertices, axis=0).max())
            if largest < SMALLEST_EXTENT:
                raise ValueError(f"mesh '{name}' must have bodies of 1 mm or more, got {largest:.3g} m for BODY={body}")
            return result._replace(report=report, bodies=split.sizes)
        points, triangles, apart = set_apart(as_one(whole, split, changes))
        if apart:
            changes.note(f"set {counted(apart, 'touching edge', 'touching edges')} apart", SET_APART)
        volume = float(np.linalg.det(points[triangles]).sum()) / 6
        if volume <= EMPTY * float(np.ptp(points, axis=0).max()) ** 3:
            raise CannotHeal("must enclose a volume, got a sheet", points[triangles[:, :2]])
        _check_removed(points, triangles, changes)
        if changes.moved > LARGEST_MOVE:
            raise CannotHeal(f"would move by {changes.moved:.2%} of its diameter", changes.where)
    except CannotHeal as error:
        if error.metres is None:
            error.metres = error.where * diameter + centre
        raise
    report = ", ".join(changes.notes) or NOTHING
    return ImportedPart(points * diameter + centre, triangles, report, changes.moved * diameter, split.sizes)


def _box(points: Array) -> Array:
    """Lowest and highest corner ``(2, 3)``."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _check_removed(vertices: Array, faces: Ints, changes: Changes) -> None:
    """What was left out must lie on the surface, or inside."""
    if not changes.removed:
        return
    removed = np.concatenate(changes.removed)
    points = removed.mean(axis=1)
    if (np.linalg.norm(np.cross(removed[:, 1] - removed[:, 0], removed[:, 2] - removed[:, 0]), axis=1) > 0).any():
        points = np.concatenate([points, uniform_points(removed, REMOVED_POINTS, np.random.default_rng(0))[0]])
    points = points[np.random.default_rng(0).permutation(len(points))[: 2 * REMOVED_POINTS]]
    away = SurfaceDistance(vertices, faces)(points)
    is_outside = away > LARGEST_MOVE
    is_outside[is_outside] = ~inside(points[is_outside], vertices, faces)
    moved = float(np.where(is_outside, away, np.minimum(away, 0.0)).max())
    if moved > LARGEST_MOVE:
        raise CannotHeal(f"has {len(removed)} faces that enclose nothing, up to {moved:.2%} of its diameter "
                         "from the solid", removed[:, [0, 1]])  # fmt: skip


def _refusal(error: CannotHeal, name: str, vertices: Array, faces: Ints, picture: Path | None) -> str:
    seen = ""
    if picture is not None and error.metres is not None and len(error.metres):
        from attentionvote.cad.refusal_picture import write_refusal
        from attentionvote.files import whole

        where = error.metres
        whole(picture, lambda path: write_refusal(vertices[faces], where, f"{name} {error}", path))
        seen = f"; {picture} shows where"
    return f"mesh '{name}' {error}{seen}; close it in the CAD program and export it again, or export STEP"
