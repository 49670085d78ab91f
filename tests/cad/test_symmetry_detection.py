"""Detected symmetries: known solids in their own frame and in any other, false friends, the check meshes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from surface_symmetry import symmetry_residual

from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
from attentionvote.cad.mesh_file import largest_vertex_distance, load_surface
from attentionvote.cad.symmetry_detection import detect_symmetry, hidden_symmetry
from attentionvote.cad.symmetry_groups import describe
from attentionvote.geometry.pose import (
    apply,
    inverse,
    matrix_from_quaternion,
    random_quaternion,
    rotation_about,
    transform,
)
from attentionvote.geometry.symmetry import Symmetry

ANYWHERE = transform(matrix_from_quaternion([0.3, -0.5, 0.7, 0.4]), [0.4, -1.0, 2.0])


def angle_iron(second_arm: float) -> trimesh.Trimesh:
    arms = [[[0, 0, 0], [1, 0.2, 0.15]], [[0, 0, 0], [0.2, second_arm, 0.15]]]
    return trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in arms])


@cache
def solid(name: str) -> trimesh.Trimesh:
    c = trimesh.creation
    return {
        "brick": lambda: c.box([1, 0.7, 0.4]),
        "square bar": lambda: c.box([1, 1, 1.9]),
        "cube": lambda: c.box([1, 1, 1]),
        "tetrahedron": lambda: trimesh.convex.convex_hull([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
        "hexagonal prism": lambda: c.cylinder(0.5, 0.6, sections=6),
        "cylinder": lambda: c.cylinder(0.5, 1.4, sections=64),
        "cone": lambda: c.cone(0.4, 1.5, sections=64),
        "equal angle iron": lambda: angle_iron(1.0),
        "unequal angle iron": lambda: angle_iron(0.6),
        "ball": lambda: c.icosphere(3),
    }[name]()


EXPECTED = {
    "brick": ("dihedral", 2, False),
    "hexagonal prism": ("dihedral", 6, False),
    "cylinder": ("revolution", 1, True),
    "cone": ("revolution", 1, False),
    # The half turn about the diagonal in its middle plane exchanges the arms.
    "equal angle iron": ("cyclic", 2, False),
    "unequal angle iron": ("none", 1, False),
    "square bar": ("dihedral", 4, False),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_solid_in_any_pose_has_its_group_about_the_principal_frame(name: str) -> None:
    mesh = solid(name)
    vertices = apply(ANYWHERE, mesh.vertices * 0.1)
    finding = detect_symmetry(vertices, mesh.faces)
    assert (finding.symmetry.kind, finding.symmetry.order, finding.symmetry.flip) == EXPECTED[name]
    # The origin was outside of the part, so it was moved to the centroid with z along the axis.
    assert finding.moved
    if name != "unequal angle iron":
        assert finding.symmetry.axis == pytest.approx((0, 0, 1), abs=1e-9)
    in_part_frame = apply(finding.part_from_file, vertices)
    assert np.linalg.det(finding.part_from_file[:3, :3]) == pytest.approx(1)
    assert symmetry_residual(in_part_frame, mesh.faces, finding.symmetry) <= finding.tolerance
    assert finding.residual <= finding.tolerance < finding.runner_up_residual


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size", "is_posed"), [("cube", 24, True), ("tetrahedron", 12, False)])
def test_a_polyhedron_has_all_its_rotations(name: str, size: int, is_posed: bool) -> None:
    mesh = solid(name)
    vertices = apply(ANYWHERE, mesh.vertices) if is_posed else mesh.vertices
    finding = detect_symmetry(vertices, mesh.faces)
    assert finding.symmetry.kind == "group"
    rotations = finding.symmetry.rotations()
    assert len(rotations) == size
    assert finding.moved == is_posed
    # Every vertex goes exactly to a vertex.
    corners = apply(finding.part_from_file, vertices)
    turned = np.einsum("gij,vj->gvi", rotations, corners)
    nearest = np.linalg.norm(turned[:, :, None] - corners, axis=-1).min(-1)
    assert nearest.max() < 1e-6


@pytest.mark.slow
def test_a_ball_has_no_orientation() -> None:
    mesh = solid("ball")
    with pytest.raises(ValueError, match="must not be a ball"):
        detect_symmetry(mesh.vertices, mesh.faces)


@pytest.mark.parametrize("name", ["connecting_rod", "vertical_bearing_pedestal", "brick", "gear"])
def test_a_builtin_keeps_its_frame_and_has_the_configured_symmetry(name: str) -> None:
    vertices, faces = builtin_surface(name)
    finding = detect_symmetry(vertices, faces)
    assert finding.symmetry == BUILTIN_PARTS[name].symmetry
    assert not finding.moved
    np.testing.assert_array_equal(finding.part_from_file, np.eye(4))


def test_a_revolution_about_another_axis_through_the_origin_stays_there() -> None:
    mesh = solid("cone")
    lying = apply(transform(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), [0, 0, 0]), mesh.vertices)
    finding = detect_symmetry(lying, mesh.faces)
    assert finding.symmetry == Symmetry("revolution", (1.0, 0.0, 0.0))
    assert not finding.moved


def test_an_axis_beside_the_origin_moves_the_part() -> None:
    vertices, faces = builtin_surface("connecting_rod")
    shift = np.array([0.002, 0.0, 0.0])
    finding = detect_symmetry(vertices + shift, faces)
    assert finding.moved
    assert finding.symmetry == Symmetry("cyclic", order=2)
    # The bores' direction stays z; the origin goes to the surface centroid, which is on the axis.
    np.testing.assert_allclose(inverse(finding.part_from_file)[:2, 3], shift[:2], atol=1e-6)
    np.testing.assert_allclose(np.abs(finding.part_from_file[:3, :3]), np.eye(3), atol=1e-6)


@pytest.mark.parametrize(
    ("radius", "sections", "kind", "order"),
    [(0.03, 8, "dihedral", 8), (0.3, 8, "dihedral", 8), (0.3, 15, "dihedral", 15), (0.3, 16, "revolution", 1),
     (0.03, 15, "revolution", 1)],
)  # fmt: skip
def test_sixteen_facets_are_a_circle_and_fewer_are_meant(radius: float, sections: int, kind: str, order: int) -> None:
    # Of the thin bar of 15 sides the facets are .07 % of the diameter high: no sensor sees the difference.
    bar = trimesh.creation.cylinder(radius, 1.0, sections=sections)
    found = detect_symmetry(np.array(bar.vertices), bar.faces).symmetry
    assert (found.kind, found.order) == (kind, order)


def test_a_gear_of_24_teeth_keeps_them(spur_gear: trimesh.Trimesh) -> None:
    found = detect_symmetry(np.array(spur_gear.vertices), spur_gear.faces).symmetry
    assert (found.kind, found.order) == ("dihedral", 24)


def test_a_shaft_of_20_splines_keeps_them() -> None:
    keys = [trimesh.creation.box(bounds=[[0.9, -0.08, -2], [1.1, 0.08, 2]]) for _ in range(20)]
    for i, key in enumerate(keys):
        key.apply_transform(transform(rotation_about((0, 0, 1), i * np.pi / 10), [0, 0, 0]))
    shaft = trimesh.boolean.union([trimesh.creation.cylinder(1.0, 4.0, sections=80), *keys])
    found = detect_symmetry(np.array(shaft.vertices), shaft.faces).symmetry
    assert (found.kind, found.order) == ("dihedral", 20)


def test_exact_symmetries_come_before_inexact_ones() -> None:
    # The third turns of a cube would be .15 mm off: of this block they are none, its quarter turns are.
    block = trimesh.creation.box([0.040, 0.040, 0.0403])
    finding = detect_symmetry(np.array(block.vertices), block.faces)
    assert finding.symmetry == Symmetry("dihedral", order=4, flip_axis=finding.symmetry.flip_axis)
    hidden = hidden_symmetry(np.array(block.vertices), block.faces, finding)
    assert hidden is not None
    assert len(hidden.symmetry.rotations()) == 24
    assert 0.0001 < hidden.residual < 0.0003


@pytest.mark.parametrize("sections", [33, 64, 65, 100])
def test_a_disc_with_one_hole_has_its_half_turn_whatever_the_triangulation(sections: int) -> None:
    hole = trimesh.creation.cylinder(0.004, 0.02, sections=sections // 3)
    hole.apply_translation([0.0303, 0.011, 0])
    disc = trimesh.boolean.difference([trimesh.creation.cylinder(0.05, 0.008, sections=sections), hole])
    finding = detect_symmetry(np.array(disc.vertices), disc.faces)
    assert (finding.symmetry.kind, finding.symmetry.order) == ("cyclic", 2)
    across = np.linalg.inv(finding.part_from_file)[:3, :3] @ finding.symmetry.axis
    assert abs(across @ [0.0303, 0.011, 0]) == pytest.approx(np.hypot(0.0303, 0.011), rel=1e-3)


def test_a_sheet_is_not_turned_over_within_its_thickness() -> None:
    plate = trimesh.creation.box([0.4, 0.4, 0.003])
    raised = trimesh.creation.box(bounds=[[-0.15, -0.15, 0.0], [0.15, 0.15, 0.0025]])
    part = trimesh.boolean.union([plate, raised])
    finding = detect_symmetry(np.array(part.vertices), part.faces, 0.02)  # of 566 mm: 11 mm
    assert finding.tolerance == pytest.approx(0.0004, rel=1e-6)
    assert finding.symmetry == Symmetry("cyclic", order=4)


def test_a_groove_that_a_sensor_overlooks_is_offered_and_not_taken() -> None:
    bar = trimesh.creation.cylinder(0.01, 0.1, sections=64)
    groove = trimesh.creation.box(bounds=[[0.0098, -0.002, -0.03], [0.02, 0.002, 0.03]])
    part = trimesh.boolean.difference([bar, groove])
    finding = detect_symmetry(np.array(part.vertices), part.faces)
    assert (finding.symmetry.kind, finding.symmetry.order) == ("cyclic", 2)
    hidden = hidden_symmetry(np.array(part.vertices), part.faces, finding)
    assert hidden is not None
    assert (hidden.symmetry.kind, hidden.symmetry.flip) == ("revolution", True)
    assert hidden.residual == pytest.approx(0.0002, abs=5e-5)


def test_what_is_below_the_tolerance_is_no_difference() -> None:
    c = trimesh.creation
    for height, tolerance, kind, order in ((0.02, 0.003, "cyclic", 2), (0.02, 0.03, "dihedral", 2)):
        mark = c.box(bounds=[[-0.2, -0.1, 0.19], [0.2, 0.1, 0.2 + height]])
        plate = trimesh.boolean.union([c.box([1, 0.7, 0.4]), mark])
        found = detect_symmetry(plate.vertices, plate.faces, tolerance).symmetry
        assert (found.kind, found.order) == (kind, order)


def test_a_random_blob_has_none() -> None:
    rng = np.random.default_rng(4)
    blob = trimesh.convex.convex_hull(rng.normal(size=(30, 3)))
    finding = detect_symmetry(blob.vertices, blob.faces)
    assert finding.symmetry == Symmetry()
    assert finding.runner_up_residual > finding.tolerance


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 0.2, float("nan")])
def test_an_impossible_tolerance_is_refused(tolerance: float) -> None:
    mesh = solid("brick")
    with pytest.raises(ValueError, match=r"symmetry tolerance must be above 0 and at most 0\.05"):
        detect_symmetry(mesh.vertices, mesh.faces, tolerance)


def test_the_bunny_has_none(shared_data: Callable[[str], Path]) -> None:
    vertices, faces = load_surface(shared_data("meshes/SileaneBunny.obj"))
    finding = detect_symmetry(vertices, faces)
    assert finding.symmetry == Symmetry()
    assert not finding.moved
    assert finding.runner_up_residual > 0.1 * largest_vertex_distance(vertices)


def test_a_gear_shaft_of_eleven_facets_is_offered_as_a_revolution(
    shared_data: Callable[[str], Path],
) -> None:
    vertices, faces = load_surface(shared_data("meshes/IPAGearShaft.stl"))
    finding = detect_symmetry(vertices, faces)
    assert finding.symmetry == Symmetry()
    hidden = hidden_symmetry(vertices, faces, finding)
    assert hidden is not None
    assert hidden.symmetry == Symmetry("revolution")
    assert not hidden.moved
    assert hidden.residual < 0.003 * hidden.diameter


def test_a_part_turned_is_the_same_part() -> None:
    vertices, faces = builtin_surface("slider_bearing_pedestal")
    rng = np.random.default_rng(9)
    for _ in range(3):
        pose = transform(matrix_from_quaternion(random_quaternion(rng)), rng.normal(size=3))
        assert describe(detect_symmetry(apply(pose, vertices), faces).symmetry) == "cyclic of order 2 about (0 0 1)"


def stadium(facets: int) -> trimesh.Trimesh:
    """100 x 40 x 20 mm, half circles of facets at both ends, two flat sides."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, facets // 2 + 1)
    half = 0.02 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline = np.concatenate([half + np.array([0.03, 0]), -half - np.array([0.03, 0])])
    rings = [np.column_stack([outline, np.full(len(outline), z)]) for z in (-0.01, 0.01)]
    return trimesh.convex.convex_hull(np.concatenate(rings))


@pytest.mark.parametrize(("facets", "depth"), [(16, 0.001), (24, 0.0003)])
def test_a_groove_in_a_plane_between_fillets_is_seen(facets: int, depth: float) -> None:
    # The plane ends in curves, but is none: what lies in it is measured to the tolerance.
    groove = trimesh.creation.box(bounds=[[0.014, 0.02 - depth, -0.004], [0.026, 0.03, 0.004]])
    part = trimesh.boolean.difference([stadium(facets), groove])
    assert detect_symmetry(np.array(part.vertices), part.faces).symmetry == Symmetry()
    whole = stadium(facets)
    found = detect_symmetry(np.array(whole.vertices), whole.faces).symmetry
    assert (found.kind, found.order) == ("dihedral", 2)


@pytest.mark.slow
@pytest.mark.parametrize(("hub", "kind"), [(False, "dihedral"), (True, "cyclic")])
def test_a_compact_gear_of_17_teeth_keeps_them(hub: bool, kind: str) -> None:
    # Its three principal moments are nearly equal, and no small order tells of the teeth.
    angle = np.arange(68) * 2 * np.pi / 68
    radius = np.where(np.arange(68) % 4 < 2, 0.011, 0.009)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    length = 0.0185 if hub else 0.01925
    rings = [np.column_stack([rim, np.full(68, z)]) for z in (0.0, length)]
    i, j = np.arange(68), (np.arange(68) + 1) % 68
    sides = [np.stack([i, j, j + 68], 1), np.stack([i, j + 68, i + 68], 1)]
    ends = [np.stack([np.full(68, 136), j, i], 1), np.stack([np.full(68, 137), i + 68, j + 68], 1)]
    gear = trimesh.Trimesh(np.concatenate([*rings, [[0, 0, 0], [0, 0, length]]]), np.concatenate(sides + ends))
    if hub:
        boss = trimesh.creation.cylinder(0.006, 0.004, sections=48)
        boss.apply_translation([0, 0, length])
        gear = trimesh.boolean.union([gear, boss])
    found = detect_symmetry(np.array(gear.vertices), gear.faces).symmetry
    assert (found.kind, found.order) == (kind, 17)
