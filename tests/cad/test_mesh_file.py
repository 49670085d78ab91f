"""Mesh files: what is read, converted, repaired and refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from attentionvote.cad.mesh_file import FEW_CORNERS, FORMATS, largest_vertex_distance, load_surface, write_surface


def wedge() -> trimesh.Trimesh:
    return trimesh.convex.convex_hull([[0, 0, 0], [60, 0, 0], [0, 30, 0], [0, 0, 20], [10, 5, 25]])


def written(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(("units", "scale"), [("m", 1000.0), ("cm", 10.0), ("mm", 1.0), ("inch", 25.4)])
def test_every_format_and_unit_gives_the_same_metres(tmp_path: Path, suffix: str, units: str, scale: float) -> None:
    mesh = wedge()
    expected = np.sort(mesh.vertices, axis=0) / 1000
    mesh.apply_scale(1 / scale)
    vertices, faces = load_surface(written(mesh, tmp_path / f"wedge{suffix}"), units)
    assert vertices.dtype == np.float64
    assert len(faces) == len(mesh.faces)
    np.testing.assert_allclose(np.sort(vertices, axis=0), expected, atol=1e-7)
    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0


def test_a_surface_inside_out_is_turned(tmp_path: Path) -> None:
    mesh = wedge()
    mesh.invert()
    vertices, faces = load_surface(written(mesh, tmp_path / "wedge.stl"), "mm")
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(wedge().volume * 1e-9, rel=1e-5)


def test_one_face_turned_is_repaired(tmp_path: Path) -> None:
    mesh = wedge()
    mesh.faces[1] = mesh.faces[1][::-1]
    vertices, faces = load_surface(written(mesh, tmp_path / "wedge.ply"), "mm")
    assert trimesh.Trimesh(vertices, faces, process=False).is_winding_consistent


def test_two_bodies_in_one_file_are_one_surface(tmp_path: Path) -> None:
    other = wedge()
    other.apply_translation([100, 0, 0])
    scene = trimesh.Scene([wedge(), other])
    scene.export(tmp_path / "two.glb")
    assert len(load_surface(tmp_path / "two.glb", "mm")[1]) == 2 * len(wedge().faces)


def test_a_hole_is_refused_with_its_open_edges(tmp_path: Path) -> None:
    mesh = trimesh.Trimesh(wedge().vertices, wedge().faces[1:], process=False)
    with pytest.raises(ValueError, match=r"'open.stl' must be watertight, got 3 open edges and 0 edges of more"):
        load_surface(written(mesh, tmp_path / "open.stl"), "mm")


def test_an_edge_of_three_faces_is_refused(tmp_path: Path) -> None:
    mesh = wedge()
    fin = trimesh.Trimesh(np.vstack([mesh.vertices, [[99, 99, 99]]]), np.vstack([mesh.faces, [*mesh.faces[0][:2], 5]]))
    with pytest.raises(ValueError, match="got 2 open edges and 1 edges of more than two faces"):
        load_surface(written(fin, tmp_path / "fin.ply"), "mm")


@pytest.mark.parametrize(
    ("units", "message"),
    [("m", r"got 60 m with units=m; try units=mm \(0.06 m\)"), ("inch", "try units=mm")],
)
def test_a_part_too_large_names_the_units_to_try(tmp_path: Path, units: str, message: str) -> None:
    mesh = wedge()
    mesh.apply_scale(1 if units == "m" else 10)
    with pytest.raises(ValueError, match=message):
        load_surface(written(mesh, tmp_path / "wedge.stl"), units)


def test_a_part_too_small_names_the_units_to_try(tmp_path: Path) -> None:
    mesh = wedge()
    mesh.apply_scale(0.001)
    with pytest.raises(ValueError, match=r"1 mm and 5 m long, got 6e-05 m with units=mm; try units=m \(0.06 m\)"):
        load_surface(written(mesh, tmp_path / "wedge.stl"), "mm")


def test_nan_is_refused(tmp_path: Path) -> None:
    mesh = wedge()
    vertices = mesh.vertices.copy()
    vertices[2, 1] = np.nan
    broken = trimesh.Trimesh(vertices, mesh.faces, process=False)
    with pytest.raises(ValueError, match=r"must have finite vertices, got \d+ NaN or inf"):
        load_surface(written(broken, tmp_path / "nan.ply"), "mm")


def test_a_flat_sheet_encloses_nothing(tmp_path: Path) -> None:
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]], [[0, 1, 2], [0, 2, 3], [1, 0, 3], [1, 3, 2]], process=False
    )
    with pytest.raises(ValueError, match="must enclose a volume"):
        load_surface(written(sheet, tmp_path / "sheet.ply"), "mm")


def test_rubbish_missing_files_and_unknown_words_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rubbish.glb").write_bytes(b"no mesh at all")
    with pytest.raises(ValueError, match=r"mesh 'rubbish.glb' could not be read as GLB"):
        load_surface(tmp_path / "rubbish.glb")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    with pytest.raises(ValueError, match=r"empty\.obj"):
        load_surface(tmp_path / "empty.obj")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.stl' does not exist"):
        load_surface(tmp_path / "nowhere.stl")
    with pytest.raises(ValueError, match=r"must end in one of .stl, .obj, .ply, .glb, got 'part.step'"):
        load_surface(tmp_path / "part.step")
    with pytest.raises(ValueError, match="units must be one of m, cm, mm, inch, got 'feet'"):
        load_surface(tmp_path / "nowhere.stl", "feet")


def test_a_sliver_is_left_out_only_where_that_opens_nothing(tmp_path: Path) -> None:
    # An edge with a vertex on one side only, and a needle of no height between: the box is closed by the needle alone.
    cube = trimesh.creation.box([10, 10, 10])
    corners = np.vstack([cube.vertices, cube.vertices[cube.faces[0, :2]].mean(axis=0)])
    a, b, c = cube.faces[0]
    faces = np.vstack([cube.faces[1:], [[a, 8, c], [8, b, c], [a, b, 8]]])
    needle = trimesh.Trimesh(corners, faces, process=False)
    vertices, read = load_surface(written(needle, tmp_path / "needle.ply"), "mm")
    assert len(read) == 14
    assert trimesh.Trimesh(vertices, read, process=False).volume == pytest.approx(1e-6)
    # Twice the same sliver, back to back, is thin as well, and goes as it always did.
    loose = trimesh.Trimesh(corners, np.vstack([cube.faces, [[a, b, 8], [a, 8, b]]]), process=False)
    assert len(load_surface(written(loose, tmp_path / "loose.ply"), "mm")[1]) == 12


@pytest.mark.parametrize(
    ("scale", "units", "message"),
    [
        (1.0, "m", r"got 60 m; a GLB is in metres by definition: export it again in its true size"),
        (0.001, "mm", r"got 6e-05 m with units=mm; a GLB is in metres by definition: leave units out \(0.06 m\)"),
        (1e-6, "inch", r"with units=inch; a GLB is in metres by definition: export it again in its true size"),
    ],
)
def test_the_advice_for_a_glb_names_no_other_unit(tmp_path: Path, scale: float, units: str, message: str) -> None:
    mesh = wedge()
    mesh.apply_scale(scale)
    with pytest.raises(ValueError, match=message) as error:
        load_surface(written(mesh, tmp_path / "wedge.glb"), units)
    assert "try units" not in str(error.value)


def test_write_surface_is_read_back(tmp_path: Path) -> None:
    mesh = wedge()
    write_surface(mesh.vertices / 1000, mesh.faces, tmp_path / "wedge.ply")
    vertices, faces = load_surface(tmp_path / "wedge.ply")
    np.testing.assert_allclose(vertices, mesh.vertices / 1000, atol=1e-8)
    np.testing.assert_array_equal(faces, mesh.faces)


@given(st.integers(0, 2**32 - 1), st.integers(4, 60), st.integers(1, 3))
def test_largest_vertex_distance_is_the_largest_of_all_pairs(seed: int, count: int, dimensions: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points[:, dimensions:] = 0.5  # flat and straight clouds have no hull
    assert largest_vertex_distance(points) == pytest.approx(pdist(points).max(), abs=1e-12)


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.uv_sphere(3.0, count=[60, 60]),  # each corner is as far from the one across
        trimesh.creation.torus(20, 5, major_sections=150, minor_sections=48),
        trimesh.creation.capsule(5, 3, [70, 70]).apply_translation([100, 7, 3]),
    ],
    ids=["ball", "ring", "capsule"],
)
def test_thousands_of_corners_give_the_same_digits_as_each_with_each(mesh: trimesh.Trimesh) -> None:
    corners = mesh.vertices[ConvexHull(mesh.vertices).vertices]
    assert len(corners) > FEW_CORNERS
    each = max(float(np.linalg.norm(corners - corner, axis=1).max()) for corner in corners)
    assert largest_vertex_distance(np.asarray(mesh.vertices)) == each  # D is part of digests: not approximately


def test_the_measured_sizes_of_the_check_meshes(shared_data: Callable[[str], Path]) -> None:
    bunny, _ = load_surface(shared_data("meshes/SileaneBunny.obj"))
    assert largest_vertex_distance(bunny) == pytest.approx(0.196575, abs=1e-6)
    shaft, faces = load_surface(shared_data("meshes/IPAGearShaft.stl"))
    assert largest_vertex_distance(shaft) == pytest.approx(0.437431, abs=1e-6)
    assert len(faces) == 2322
