"""Surfaces from files: read, converted to metres, and checked before anything is built on them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist, pdist

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
FORMATS = (".stl", ".obj", ".ply", ".glb")
# Of these the unit is no guess.
UNIT_KNOWN = {
    ".glb": "a GLB is in metres by definition",
    ".step": "a STEP file says its unit",
    ".stp": "a STEP file says its unit",
}
FEW_CORNERS = 3000  # of a hull: so many are compared each with each
CORNERS_IN_A_GROUP = 64
SMALLEST_EXTENT, LARGEST_EXTENT = 0.001, 5.0


def load_surface(path: str | Path, units: str = "m") -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` in metres and outward faces ``(F, 3)`` of a mesh file, in the file's frame.

    Duplicate vertices are merged first (STL has no shared ones). A surface that is closed but inside out
    is turned; everything else that is wrong is refused.

    Args:
        path: an STL, OBJ, PLY or GLB file; several bodies of one file are joined.
        units: unit of the file's numbers: m, cm, mm or inch (STL and OBJ do not say).

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: with one sentence, when it is no readable, finite, watertight, consistently oriented
            solid of plausible size.
    """
    path = Path(path)
    if units not in METRES_PER_UNIT:
        raise ValueError(f"units must be one of {', '.join(METRES_PER_UNIT)}, got {units!r}")
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"mesh file must end in one of {', '.join(FORMATS)}, got '{path.name}'")
    if not path.is_file():
        raise FileNotFoundError(f"mesh file '{path}' does not exist")
    mesh = read_mesh(path)
    mesh.apply_scale(METRES_PER_UNIT[units])
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(
            f"mesh '{path.name}' must have finite vertices, got {(~np.isfinite(mesh.vertices)).sum()} NaN or inf"
        )
    check_size(mesh.extents, units, path.name)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    _leave_out_slivers(mesh)
    mesh.remove_unreferenced_vertices()
    _check_solid(mesh, path.name)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def check_size(extents: NDArray[np.float64], units: str, name: str) -> None:
    """Refuse a part larger than 5 m or smaller than 1 mm: its units are almost surely wrong.

    Raises:
        ValueError: naming the units that would give a plausible size.
    """
    largest = float(extents.max())
    if SMALLEST_EXTENT <= largest <= LARGEST_EXTENT:
        return
    suffix = Path(name).suffix.lower()
    if suffix in UNIT_KNOWN:
        kind = UNIT_KNOWN[suffix]
        plain = largest / METRES_PER_UNIT[units]
        advice = f"{kind}: export it again in its true size"
        if units != "m" and SMALLEST_EXTENT <= plain <= LARGEST_EXTENT:
            advice = f"{kind}: leave units out ({plain:.4g} m)"
        said = f" with units={units}" if units != "m" else ""
        raise ValueError(f"mesh '{name}' must be between 1 mm and 5 m long, got {largest:.4g} m{said}; {advice}")
    size_of = {u: largest / METRES_PER_UNIT[units] * METRES_PER_UNIT[u] for u in METRES_PER_UNIT}
    # The best guess is the unit that brings the part nearest to a hand's width (geometric mean of the limits).
    best = min(size_of, key=lambda u: abs(np.log(size_of[u] / 0.1)))
    advice = (
        f"try units={best} ({size_of[best]:.4g} m)"
        if SMALLEST_EXTENT <= size_of[best] <= LARGEST_EXTENT
        else f"no unit of {', '.join(METRES_PER_UNIT)} makes it plausible"
    )
    raise ValueError(
        f"mesh '{name}' must be between 1 mm and 5 m long, got {largest:.4g} m with units={units}; {advice}"
    )


def largest_vertex_distance(vertices: NDArray[np.float64]) -> float:
    """Largest distance between two of the vertices ``(V, 3)``: the diameter as BOP defines it."""
    try:
        corners = vertices[ConvexHull(vertices).vertices]
    except QhullError:  # flat or tiny: no hull, all pairs
        corners = vertices
    if len(corners) <= FEW_CORNERS:
        return float(pdist(corners).max())
    return _largest_of_many(corners)


def _largest_of_many(corners: NDArray[np.float64]) -> float:
    """The same for thousands of corners: only groups that may lie farther apart than any pair so far are compared."""
    groups = [np.arange(len(corners))]
    while len(groups[0]) > CORNERS_IN_A_GROUP:  # halved along their longest side, all of them at once
        halves = []
        for group in groups:
            along = corners[group, np.argmax(np.ptp(corners[group], axis=0))]
            order = group[np.argsort(along, kind="stable")]
            halves += [order[len(order) // 2 :], order[: len(order) // 2]]
        groups = halves
    centres = np.array([corners[g].mean(axis=0) for g in groups])
    radii = np.array([np.linalg.norm(corners[g] - m, axis=1).max() for g, m in zip(groups, centres, strict=True)])
    first, second = np.triu_indices(len(groups))
    reach = np.linalg.norm(centres[first] - centres[second], axis=1) + radii[first] + radii[second]
    best = 0.0
    for pair in np.argsort(-reach):
        if reach[pair] < best * (1 - 1e-12):
            break
        one, other = groups[first[pair]], groups[second[pair]]
        distance = cdist(corners[one], corners[other])
        # Of all but equal pairs each is measured as it always was: D is part of digests.
        i, j = np.nonzero(distance >= max(best, float(distance.max())) * (1 - 1e-12))
        if len(i):
            best = max(best, float(np.linalg.norm(corners[one[i]] - corners[other[j]], axis=1).max()))
    return best


def read_mesh(path: Path) -> trimesh.Trimesh:
    """The triangles of a mesh file as they are in it; the nodes of a scene where its transforms place them.

    Raises:
        ValueError: with one sentence, when it cannot be read or holds no surface.
    """
    try:
        mesh = trimesh.load_mesh(path, process=False)  # its repairs would hide NaN and duplicate faces
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
    except Exception as error:  # the readers raise whatever their parser does
        raise ValueError(f"mesh '{path.name}' could not be read as {path.suffix[1:].upper()}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) < 4:
        count = len(mesh.faces) if isinstance(mesh, trimesh.Trimesh) else 0
        raise ValueError(f"mesh '{path.name}' must hold a surface of at least 4 triangles, got {count}")
    return mesh


def _leave_out_slivers(mesh: trimesh.Trimesh) -> None:
    """Leave out triangles thinner than 10 nm, unless that opens a closed surface: then only those of two corners."""
    is_fat = mesh.nondegenerate_faces()
    if is_fat.all():
        return
    has_three = (mesh.faces != np.roll(mesh.faces, 1, axis=1)).all(axis=1)
    if not _is_closed(mesh.faces[is_fat]) and _is_closed(mesh.faces[has_three]):
        is_fat = has_three
    mesh.update_faces(is_fat)


def _is_closed(faces: NDArray[np.int64]) -> bool:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _check_solid(mesh: trimesh.Trimesh, name: str) -> None:
    if len(mesh.faces) < 4:
        raise ValueError(f"mesh '{name}' must hold at least 4 triangles of non-zero area, got {len(mesh.faces)}")
    uses = np.bincount(mesh.edges_unique_inverse)
    if (uses != 2).any():
        raise ValueError(
            f"mesh '{name}' must be watertight, got {int((uses == 1).sum())} open edges and "
            f"{int((uses > 2).sum())} edges of more than two faces; close it in the CAD program and export it again"
        )
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
        if not mesh.is_winding_consistent:
            raise ValueError(
                f"mesh '{name}' must have faces of consistent orientation, got a surface with one side only"
            )
    volume = float(np.linalg.det(mesh.vertices[mesh.faces] - mesh.vertices.mean(0)).sum()) / 6
    if abs(volume) <= 1e-6 * float(mesh.extents.max()) ** 3:
        raise ValueError(f"mesh '{name}' must enclose a volume, got {abs(volume):.3g} m^3")
    if volume < 0:
        mesh.invert()


def check_written(vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str) -> None:
    """Refuse a surface ``(V, 3)``, ``(F, 3)`` that is no solid any more once ``write_surface`` has rounded it.

    Raises:
        ValueError: with one sentence that begins with the file's name.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written.ply"
        write_surface(vertices, faces, path)
        try:
            back, triangles = load_surface(path)
        except ValueError as error:
            reason = str(error).removeprefix("mesh 'written.ply' ")
            raise ValueError(f"mesh '{name}' in 32-bit metres {reason}") from error
    corners = vertices[faces] - vertices.mean(axis=0)
    volume, rounded = np.linalg.det(corners).sum(), np.linalg.det(back[triangles] - vertices.mean(axis=0)).sum()
    if abs(rounded - volume) > 1e-3 * abs(volume):
        raise ValueError(
            f"mesh '{name}' must keep its volume in 32-bit metres within 0.1 %, got {rounded / volume - 1:.2%}: "
            "its walls are too thin"
        )


def write_surface(vertices: NDArray[np.float64], faces: NDArray[np.int64], path: Path) -> None:
    """Write a PLY file in metres; 32-bit numbers, that is, to 10 nm on a part of the size of a hand."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(path, file_type="ply")
