"""A part from whatever file its owner has: read, healed, told apart from other bodies, and what was done to it.

``mesh_file.load_surface`` reads the result again, and refuses what is not whole; nothing is healed there.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.bodies import body_of, gap, inside, solids_of, united
from attentionvote.cad.healing import CannotHeal, Changes, Whole, healed, set_apart, settled
from attentionvote.cad.hole_filling import LARGEST_MOVE
from attentionvote.cad.mesh_file import FORMATS, METRES_PER_UNIT, check_size, largest_vertex_distance, read_mesh
from attentionvote.cad.step_file import STEP_FORMATS, read_step
from attentionvote.cad.surface_distance import SurfaceDistance
from attentionvote.part import uniform_points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NOTHING = "nothing to heal"
ALL = 0  # as the body: all of them are one part
MOST_NAMED = 6
REMOVED_POINTS = 200


class ImportedPart(NamedTuple):
    """A part's surface.

    Args:
        vertices: ``(V, 3)`` metres, in the file's frame.
        faces: ``(F, 3)`` outward.
        report: what was healed, one line.
        moved: how far the surface went, metres.
        bodies: sizes of the bodies in the file, one for each.
    """

    vertices: Array
    faces: Ints
    report: str
    moved: float
    bodies: list[str]


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
        return _imported(vertices, faces, path.name, body)
    except CannotHeal as error:
        raise ValueError(_refusal(error, path.name, vertices, faces, picture)) from error


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
    used = vertices[np.unique(faces)]
    check_size(used.max(axis=0) - used.min(axis=0), units or "m", path.name)
    return vertices, faces


def _imported(vertices: Array, faces: Ints, name: str, body: int | None) -> ImportedPart:
    used = np.unique(faces)
    diameter = largest_vertex_distance(vertices[used])
    centre = (vertices[used].max(axis=0) + vertices[used].min(axis=0)) / 2
    changes = Changes()
    scaled = (vertices - centre) / diameter
    whole = healed(scaled, faces, changes, diameter * 1000)
    try:
        solids = solids_of(whole.vertices, whole.faces, whole.shell)
        if solids.empty:
            is_empty = solids.solid < 0
            changes.note(
                f"left out {solids.empty} {'surface' if solids.empty == 1 else 'surfaces'} that enclose nothing"
            )
            changes.removed.append(whole.vertices[whole.faces[is_empty]])
        is_kept = solids.solid >= 0
        kept, solid = solids.faces[is_kept], solids.solid[is_kept]
        body_number, touching = body_of(whole.vertices, kept, solid)
        bodies = [_size(whole.vertices, kept[body_number[solid] == k], diameter) for k in range(body_number.max() + 1)]
        if len(bodies) > 1 and body is None:
            raise ValueError(_assembly(whole.vertices, kept, body_number[solid], diameter, bodies))
        if body is not None and not 0 <= body <= len(bodies):
            raise ValueError(f"must have the body that is asked for: BODY={body}, got {_listed(bodies)}")
        if body and len(bodies) > 1:
            # Again from the file's own triangles: what is a rounding in the whole may be a feature of this body.
            ids = np.unique(whole.source[kept[body_number[solid] == body - 1]])
            chosen = _faces_at(scaled, faces, ids)
            result = _imported(vertices, chosen, name, ALL)
            note = f"body {body} of {len(bodies)}"
            report = note if result.report == NOTHING else f"{note}; {result.report}"
            return result._replace(report=report, bodies=bodies)
        if solids.turned:
            changes.note(f"turned {solids.turned} {'surface' if solids.turned == 1 else 'surfaces'} inside out")
        if solids.cavities:
            changes.note(f"kept {solids.cavities} {'cavity' if solids.cavities == 1 else 'cavities'}")
        if len(touching):
            count = len(np.unique(touching))
            points, joined, twice = united(whole.vertices, kept, solid)
            share = twice / max(_volume(points, joined), 1e-300)
            kind = (
                f"overlapping solids ({share:.1%} of the volume was there twice)" if share > 1e-6 else "touching solids"
            )
            changes.note(f"united {count} {kind}")
            whole = settled(points, joined)
        else:
            used, compact = np.unique(kept, return_inverse=True)
            whole = Whole(whole.vertices, kept, whole.source, whole.shell[is_kept])
    except CannotHeal:
        raise
    except ValueError as error:
        raise ValueError(f"mesh '{name}' {error}") from error
    points, triangles, apart = set_apart(whole)
    if apart:
        changes.note(f"set {apart} touching {'edge' if apart == 1 else 'edges'} apart", 2e-5)
    _check_removed(points, triangles, changes)
    if changes.moved > LARGEST_MOVE:
        raise CannotHeal(f"would move by {changes.moved:.2%} of its diameter", points[triangles[:0, :2]])
    report = ", ".join(changes.notes) or NOTHING
    return ImportedPart(points * diameter + centre, triangles, report, changes.moved * diameter, bodies)


def _faces_at(vertices: Array, faces: Ints, ids: Ints) -> Ints:
    from attentionvote.cad.vertex_merging import merged

    is_there = np.zeros(len(vertices), dtype=bool)
    is_there[ids] = True
    return faces[is_there[merged(vertices)[0][faces]].any(axis=1)]


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


def _volume(vertices: Array, faces: Ints) -> float:
    return float(np.linalg.det(vertices[faces]).sum()) / 6


def _size(vertices: Array, faces: Ints, diameter: float) -> str:
    extent = np.ptp(vertices[np.unique(faces)], axis=0) * diameter * 1000
    return " x ".join(f"{e:.1f}" for e in extent) + " mm"


def _listed(bodies: list[str]) -> str:
    more = f" and {len(bodies) - MOST_NAMED} more" if len(bodies) > MOST_NAMED else ""
    what = "1 body" if len(bodies) == 1 else f"{len(bodies)} bodies"
    return f"{what}: " + ", ".join(f"BODY={i} ({b})" for i, b in enumerate(bodies[:MOST_NAMED], 1)) + more


def _assembly(vertices: Array, faces: Ints, body: Ints, diameter: float, bodies: list[str]) -> str:
    first = faces[body == 0]
    away = min(gap(vertices, first, faces[body == k]) for k in range(1, min(len(bodies), MOST_NAMED + 1)))
    millimetres = away * diameter * 1000
    names = [f"BODY={i} ({b})" for i, b in enumerate(bodies[:MOST_NAMED], 1)]
    if len(bodies) > MOST_NAMED:
        names.append(f"another up to BODY={len(bodies)}")
    alike = ""
    if len(bodies) == 2:
        one, two = (_alike(vertices, faces[body == k]) for k in (0, 1))
        alike = " of one size (copies, or mirror images)" if np.allclose(one, two, rtol=1e-3) else ""
    return (
        f"holds {len(bodies)} bodies{alike} {millimetres:.3g} mm apart: an assembly? {', '.join(names[:-1])} or "
        f"{names[-1]} picks one, BODY=0 takes all as one part"
    )


def _alike(vertices: Array, faces: Ints) -> Array:
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    middle = vertices[np.unique(faces)].mean(axis=0)
    return np.array([_volume(vertices - middle, faces), area])


def _refusal(error: CannotHeal, name: str, vertices: Array, faces: Ints, picture: Path | None) -> str:
    seen = ""
    if picture is not None and len(error.where):
        from attentionvote.cad.refusal_picture import write_refusal
        from attentionvote.files import whole

        used = vertices[np.unique(faces)]
        diameter = largest_vertex_distance(used)
        where = error.where * diameter + (used.max(axis=0) + used.min(axis=0)) / 2
        whole(picture, lambda path: write_refusal(vertices[faces], where, f"{name} {error}", path))
        seen = f"; {picture} shows where"
    return f"mesh '{name}' {error}{seen}; close it in the CAD program and export it again, or export STEP"
