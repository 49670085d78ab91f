"""How far turns carry a surface off itself: known distances, facets, registration."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from attentionvote.cad.rotation_check import RotationCheck
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, rotation_about


@pytest.fixture(scope="module")
def box_check() -> RotationCheck:
    box = trimesh.creation.box([3, 2, 1])
    return RotationCheck(np.array(box.vertices), box.faces, tolerance=0.01)


def test_residuals_are_the_distance_the_corners_move(box_check: RotationCheck) -> None:
    assert box_check.residual(rotation_about((0, 0, 1), np.pi)) <= 1e-5
    # A quarter turn about z carries the corner (1.5, 1) to (-1, 1.5), half a unit outside of y = 1.
    assert box_check.residual(rotation_about((0, 0, 1), np.pi / 2)) == pytest.approx(0.5, abs=1e-4)
    # A small turn moves the corner by angle * radius, of which the part along the face's normal counts.
    tilt = 0.008
    outside = np.sin(tilt) * 1.5 - (1 - np.cos(tilt)) * 1
    assert box_check.residual(rotation_about((0, 0, 1), tilt)) == pytest.approx(outside, rel=1e-3)


def test_a_turn_about_another_centre_is_measured_there(box_check: RotationCheck) -> None:
    # A half turn about (0.1, 0, z) moves the box by 0.2 along x.
    off = box_check.residual(rotation_about((0, 0, 1), np.pi), centre=np.array([0.1, 0, 0]))
    assert off == pytest.approx(0.2, abs=1e-4)


def test_a_group_holds_only_when_every_element_does(box_check: RotationCheck) -> None:
    half_turns = np.stack([rotation_about(u, np.pi) for u in np.eye(3)])
    assert box_check.holds(half_turns)
    assert not box_check.holds(np.concatenate([half_turns, rotation_about((0, 0, 1), 0.1)[None]]))
    assert box_check.worst(np.concatenate([half_turns, rotation_about((0, 0, 1), np.pi / 2)[None]])) > 0.3


def test_means_are_those_of_single_turns(box_check: RotationCheck) -> None:
    turns = np.stack([rotation_about((0, 0, 1), a) for a in (0.0, 0.1, 1.0)])
    means = box_check.means(turns)
    assert means[0] < 1e-6
    assert means[0] < means[1] < means[2]
    np.testing.assert_allclose(means[1:], [box_check.means(t[None])[0] for t in turns[1:]])


def test_registration_finds_the_symmetry_nearby(box_check: RotationCheck) -> None:
    rng = np.random.default_rng(3)
    for axis in np.eye(3):
        exact = rotation_about(axis, np.pi)
        start = matrix_from_quaternion(random_quaternion(rng) * [0, 0.05, 0.05, 0.05] + [1, 0, 0, 0]) @ exact
        assert np.abs(start - exact).max() > 0.01
        turn, shift = box_check.registered(start)
        np.testing.assert_allclose(turn, exact, atol=1e-3)
        np.testing.assert_allclose(shift, 0, atol=1e-3)


def test_registration_finds_the_translation_of_a_box_beside_its_origin() -> None:
    box = trimesh.creation.box([3, 2, 1])
    check = RotationCheck(box.vertices + np.array([0.05, 0.02, 0]), box.faces, tolerance=0.01)
    _, shift = check.registered(rotation_about((0, 0, 1), np.pi))
    np.testing.assert_allclose(shift, [0.1, 0.04, 0], atol=1e-4)


def test_facets_of_a_circle_are_no_difference_and_corners_are() -> None:
    for sections, low, high in ((20, 0.0, 2e-4), (6, 0.06, 0.07)):
        mesh = trimesh.creation.cylinder(0.5, 0.4, sections=sections)
        check = RotationCheck(np.array(mesh.vertices), mesh.faces, tolerance=1e-4)
        assert low <= check.residual(rotation_about((0, 0, 1), np.pi / sections)) <= high


def test_a_mark_on_the_end_of_a_cylinder_is_a_difference() -> None:
    # Lower than the facets of the rim are high, but away from it: no circle explains it.
    rim = trimesh.creation.cylinder(0.5, 0.2, sections=20)
    mark = trimesh.creation.box(bounds=[[0.1, -0.05, 0.0], [0.2, 0.05, 0.104]])
    mesh = trimesh.boolean.union([rim, mark])
    check = RotationCheck(np.array(mesh.vertices), mesh.faces, tolerance=1e-4)
    assert check.facet_height > 0.004
    assert check.residual(rotation_about((0, 0, 1), np.pi)) == pytest.approx(0.004, abs=1e-3)


def test_the_centre_of_a_ring_of_uneven_facets_is_that_of_its_bore() -> None:
    # Facets twice as wide on one side of the rim: the surface centroid is beside the axis.
    narrow, wide = np.linspace(0, np.pi, 41)[:-1], np.linspace(np.pi, 2 * np.pi, 21)[:-1]
    angle = np.concatenate([narrow, wide])
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc = trimesh.convex.convex_hull(np.concatenate([np.column_stack([ring, np.full(60, z)]) for z in (-0.3, 0.3)]))
    mesh = trimesh.boolean.difference([disc, trimesh.creation.cylinder(0.9, 2, sections=90)])
    centroid = mesh.area_faces @ mesh.triangles_center / mesh.area
    off = np.linalg.norm(centroid[:2])
    assert off > 4e-4
    check = RotationCheck(np.array(mesh.vertices) - centroid, mesh.faces, tolerance=1e-4)
    centre = check.centre(rotation_about((0, 0, 1), np.array([np.pi / 2, np.pi])))
    assert np.linalg.norm((centre + centroid)[:2]) < 0.7 * off
