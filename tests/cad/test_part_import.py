"""Part files as vendors write them: made whole and said how, or refused with a reason; against the sound part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from damaged_parts import COUNT, FORMATS, KINDS, DamagedPart, damaged_parts
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from trimesh.creation import annulus, box, cylinder, icosphere

from attentionvote.cad.builtin import builtin_surface
from attentionvote.cad.mesh_file import check_written, load_surface, write_surface
from attentionvote.cad.part_import import ImportedPart, import_part
from attentionvote.cad.surface_distance import SurfaceDistance


def solid_of(part: ImportedPart) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def soup(*solids: trimesh.Trimesh) -> NDArray[np.float64]:
    return np.concatenate([solid.triangles for solid in solids])


def written(triangles: NDArray[np.float64], path: Path) -> Path:
    """A file of triangles ``(F, 3, 3)`` in millimetres."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False).export(path)
    return path


def at(x: float, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    return trimesh.transformations.translation_matrix([x, y, z])


def problem_of(file: DamagedPart, folder: Path) -> str:
    """What is wrong with the import of a damaged file: nothing, a refusal, or another part than the sound one."""
    try:
        part = import_part(file.path, None, file.body)
        write_surface(part.vertices, part.faces, folder / "back.ply")
        vertices, faces = load_surface(folder / "back.ply")
    except ValueError as error:
        return f"{file.path.name}: {error}"
    back, true = trimesh.Trimesh(vertices, faces, process=False), file.sound
    diameter = float(np.linalg.norm(true.extents))
    # Nearly every vertex of the sound part is one of the healed; the surface is asked where it is not.
    far = true.vertices[cKDTree(vertices).query(true.vertices)[0] > 4e-4 * diameter]
    away = SurfaceDistance(vertices, faces)(far).max() / diameter if len(far) else 4e-4
    moved = max(away, part.moved / diameter)
    errors = {
        "volume": abs(back.volume / true.volume - 1),
        "area": abs(back.area / true.area - 1),
        "surface": 2 * moved,
    }
    wrong = {what: error for what, error in errors.items() if error > 1e-3}
    return f"{file.path.name}: {wrong} ({part.report})" if wrong else ""


def test_every_kind_of_damage_is_healed(tmp_path: Path) -> None:
    problems = [problem_of(file, tmp_path) for file in damaged_parts(tmp_path, len(KINDS))]
    assert [problem for problem in problems if problem] == []


@pytest.mark.slow
def test_of_200_damaged_files_98_percent_give_the_sound_part(tmp_path: Path) -> None:
    problems, forms, kinds = [], set(), set()
    for file in damaged_parts(tmp_path):
        problems.append(problem_of(file, tmp_path))
        kinds.add(file.kind)
        forms.add(file.path.name.split(".", 1)[1])
        file.path.unlink()
    assert len(problems) == COUNT
    assert len(kinds) == 17
    assert forms == set(FORMATS)
    wrong = [problem for problem in problems if problem]
    assert len(wrong) <= 0.02 * COUNT, "\n".join(wrong)


def test_most_of_the_damaged_files_are_refused_by_the_strict_reader(tmp_path: Path) -> None:
    refused = 0
    for file in damaged_parts(tmp_path, len(KINDS)):
        try:
            load_surface(file.path)
        except ValueError:
            refused += 1
    assert refused >= len(KINDS) // 3


def test_a_sound_file_comes_as_the_strict_reader_has_it(tmp_path: Path) -> None:
    vertices, faces = builtin_surface("brick")
    path = written(vertices[faces] * 1000, tmp_path / "brick.stl")
    part = import_part(path, "mm")
    expected, triangles = load_surface(path, "mm")
    np.testing.assert_array_equal(part.vertices, expected)
    np.testing.assert_array_equal(part.faces, triangles)
    assert (part.line, part.moved, len(part.bodies)) == ("brick.stl in mm: nothing to heal", 0.0, 1)


def test_the_line_says_what_was_done_and_how_far_it_went(tmp_path: Path) -> None:
    mesh = box([60, 40, 20])
    triangles = mesh.triangles.copy()
    triangles[3] += [0, 0, 3e-4]
    part = import_part(written(triangles[1:], tmp_path / "box.ply"), "mm")
    assert part.line.startswith("box.ply in mm: merged ")
    assert "closed 1 hole (3 open edges)" in part.line
    assert part.line.endswith("the surface moved by 0.3 um at most")
    assert part.moved == pytest.approx(3e-7, rel=0.01)
    assert solid_of(part).volume == pytest.approx(mesh.volume * 1e-9, rel=1e-4)


def test_an_assembly_is_asked_about(tmp_path: Path) -> None:
    path = written(soup(box([20, 20, 10], at(50)), box([40, 20, 10])), tmp_path / "two.stl")
    with pytest.raises(
        ValueError, match=r"'two.stl' holds 2 bodies 20 mm apart: an assembly\? BODY=1 \(40.0 x "
    ) as error:
        import_part(path, "mm")
    assert "or BODY=2 (20.0 x 20.0 x 10.0 mm) picks one, BODY=0 takes all as one part" in str(error.value)
    with pytest.raises(ValueError, match=r"'two.stl' has no BODY=3, got 2 bodies: BODY=1"):
        import_part(path, "mm", 3)
    for body, volume in ((0, 12_000), (1, 8_000), (2, 4_000)):
        part = import_part(path, "mm", body)
        assert solid_of(part).volume == pytest.approx(volume * 1e-9)
        assert len(part.bodies) == 2
    assert part.line == "two.stl in mm: body 2 of 2"


def test_a_part_and_its_mirror_image_are_two_bodies(tmp_path: Path) -> None:
    vertices, faces = builtin_surface("connecting_rod")
    rod = trimesh.Trimesh(vertices * 1000, faces, process=False)
    mirrored = rod.copy()
    mirrored.apply_transform(at(200) @ np.diag([-1.0, 1, 1, 1]))
    scene = trimesh.Scene([rod, mirrored])
    scene.export(tmp_path / "pair.glb")
    with pytest.raises(ValueError, match=r"2 bodies of one size \(copies, or mirror images\) 58.* mm apart"):
        import_part(tmp_path / "pair.glb", "mm")


def test_a_body_is_judged_by_its_own_size(tmp_path: Path) -> None:
    # Two bodies 2 m apart: a step of 10 um in the small one is a rounding of the whole and a feature of the body.
    small = trimesh.boolean.union([box([10, 10, 5]), box([6, 6, 0.02], at(0, 0, 2.5))])
    path = written(soup(box([500, 100, 100]), small.apply_transform(at(2000))), tmp_path / "far.stl")
    part = import_part(path, "mm", 2)
    assert solid_of(part).volume == pytest.approx((500 + 36 * 0.01) * 1e-9, rel=1e-5)


def test_what_touches_or_overlaps_counts_once(tmp_path: Path) -> None:
    cube, ball = box([30, 30, 30]), icosphere(2, 8)
    part = import_part(written(soup(cube, ball), tmp_path / "in.stl"), "mm")
    assert solid_of(part).volume == pytest.approx(27e-6, rel=1e-6)
    assert part.report == f"united 2 overlapping solids ({ball.volume / cube.volume:.1%} of the volume was there twice)"
    ball.invert()
    part = import_part(written(soup(cube, ball), tmp_path / "cavity.stl"), "mm")
    assert solid_of(part).volume == pytest.approx((cube.volume + ball.volume) * 1e-9, rel=1e-6)
    assert part.report == "kept 1 cavity"


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_cubes_that_touch_in_every_way_fill_their_volume(tmp_path: Path, turn: float) -> None:
    # Half of 27 cells at random: contacts by faces, by edges of four and six faces, by corners, and cavities.
    for seed in range(8):
        cells = np.argwhere(np.random.default_rng(seed).random((3, 3, 3)) < 0.5)
        cubes = trimesh.util.concatenate([box([10, 10, 10], at(*(10.0 * cell))) for cell in cells])
        cubes.apply_transform(trimesh.transformations.rotation_matrix(turn, [1, 2, 3]))
        part = import_part(written(cubes.triangles, tmp_path / "cubes.ply"), "mm", 0)
        check_written(part.vertices, part.faces, "cubes.ply")
        assert solid_of(part).volume == pytest.approx(len(cells) * 1e-6, rel=1e-3)
        assert part.moved <= 2.1e-5 * np.linalg.norm(cubes.extents) / 1000


def test_any_triangles_become_a_solid_or_one_sentence(tmp_path: Path) -> None:
    accepted = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        corners = rng.normal(size=(rng.integers(4, 12), 3)) * 10
        faces = rng.integers(len(corners), size=(rng.integers(4, 60), 3))
        if seed % 2:  # nearly whole: a ball with a few faces anywhere
            ball = icosphere(1, 10)
            corners, faces = np.asarray(ball.vertices), np.asarray(ball.faces).copy()
            faces[rng.integers(len(faces), size=3)] = rng.integers(len(corners), size=(3, 3))
        trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "any.ply")
        try:
            part = import_part(tmp_path / "any.ply", "mm", 0)
            check_written(part.vertices, part.faces, "any.ply")
            accepted += 1
            assert solid_of(part).volume > 0
        except ValueError as error:
            assert str(error).startswith("mesh 'any.ply' "), seed  # noqa: PT017
    assert 5 < accepted < 35


def test_a_ball_in_a_cavity_is_a_body_of_its_own(tmp_path: Path) -> None:
    shell = icosphere(2, 12)
    shell.invert()
    path = written(soup(box([30, 30, 30]), shell, icosphere(2, 8)), tmp_path / "rattle.stl")
    with pytest.raises(ValueError, match="holds 2 bodies 3"):
        import_part(path, "mm")


@pytest.mark.parametrize(
    ("name", "triangles", "message"),
    [
        (
            "cup",
            cylinder(10, 30, sections=40).triangles[cylinder(10, 30, sections=40).face_normals[:, 2] < 0.5],
            "must be watertight, got 40 open edges about holes too large",
        ),
        (
            "tube",
            cylinder(10, 30).triangles[np.abs(cylinder(10, 30).face_normals[:, 2]) < 0.5],
            "is a sheet and no solid: 64 of its edges are open",
        ),
        (
            "fin",
            np.concatenate([box([10, 10, 10]).triangles, [[[5, 5, 5], [5, 5, -5], [15, 15, 0]]]]),
            "has 1 faces that enclose nothing, up to 4.* % of its diameter from the solid".replace(" %", "%"),
        ),
    ],
)
def test_what_would_be_invented_is_refused_with_a_picture(
    tmp_path: Path, name: str, triangles: NDArray[np.float64], message: str
) -> None:
    picture = tmp_path / "parts" / f"{name}-refused.png"
    path = written(triangles, tmp_path / f"{name}.stl")
    with pytest.raises(ValueError, match=message) as error:
        import_part(path, "mm", None, picture)
    assert f"; {picture} shows where; close it in the CAD program" in str(error.value)
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=message) as error:
        import_part(path, "mm")
    assert "shows where" not in str(error.value)


def test_an_import_that_works_removes_the_picture_of_one_before(tmp_path: Path) -> None:
    (tmp_path / "old.png").write_bytes(b"of an attempt before")
    import_part(written(soup(box([9, 9, 9])), tmp_path / "box.stl"), "mm", None, tmp_path / "old.png")
    assert not (tmp_path / "old.png").exists()


def test_nodes_of_a_scene_lie_where_their_transforms_place_them(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    plate = annulus(5, 10, 4)
    scene.add_geometry(plate, node_name="below", geom_name="plate")
    scene.graph.update("above", geometry="plate", matrix=at(0, 0, 4) @ np.diag([1.0, 1, -1, 1]))
    scene.export(tmp_path / "stack.glb")
    part = import_part(tmp_path / "stack.glb", "mm")
    assert solid_of(part).volume == pytest.approx(2 * plate.volume * 1e-9, rel=1e-5)
    np.testing.assert_allclose(solid_of(part).extents, [0.02, 0.02, 0.008], rtol=1e-5)


def test_a_surface_that_rounding_destroys_is_refused() -> None:
    sheet = box([1, 1, 1])
    far = sheet.vertices * [0.1, 0.1, 2e-9] + [0, 0, 1]
    with pytest.raises(ValueError, match=r"mesh 'foil.stl' in 32-bit metres must "):
        check_written(far, sheet.faces, "foil.stl")
    check_written(sheet.vertices * 0.1, sheet.faces, "box.stl")
