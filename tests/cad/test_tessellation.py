"""The height of facets: exact for circles, at least the error of spheres, none for what is meant to be flat."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from attentionvote.cad.tessellation import facet_heights


def heights(mesh: trimesh.Trimesh) -> np.ndarray:
    return facet_heights(np.array(mesh.vertices), np.array(mesh.faces))


@pytest.mark.parametrize("sections", [16, 24, 65, 200])
def test_the_height_over_a_circle_is_its_sagitta(sections: int) -> None:
    mesh = trimesh.creation.cylinder(0.5, 1.4, sections=sections)
    is_side = np.abs(mesh.face_normals[:, 2]) < 0.5
    found = heights(mesh)
    assert (found[~is_side] == 0).all()
    np.testing.assert_allclose(found[is_side], 0.5 * (1 - np.cos(np.pi / sections)), rtol=0.01)


@pytest.mark.parametrize("sections", [3, 6, 12, 15])
def test_fewer_than_sixteen_sides_are_meant(sections: int) -> None:
    assert (heights(trimesh.creation.cylinder(0.5, 1.4, sections=sections)) == 0).all()


def test_a_facet_cut_into_many_triangles_is_one() -> None:
    mesh = trimesh.creation.cylinder(0.5, 1.4, sections=24)
    whole = heights(mesh).max()
    finer = trimesh.Trimesh(*trimesh.remesh.subdivide(mesh.vertices, mesh.faces))
    assert heights(finer).max() == pytest.approx(whole, rel=1e-6)


@pytest.mark.parametrize("subdivisions", [3, 4])
def test_a_sphere_lies_within_the_heights_of_its_facets(subdivisions: int) -> None:
    mesh = trimesh.creation.icosphere(subdivisions, radius=0.5)
    deepest = 0.5 - np.linalg.norm(mesh.triangles_center, axis=1)
    found = heights(mesh)
    assert (found > 0.8 * deepest).all()
    assert (found < 2 * deepest).all()


def test_a_plane_between_fillets_is_flat() -> None:
    # A stadium: half circles of 16 facets each between planes forty times as wide as a facet.
    angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
    half = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline = np.concatenate([half + np.array([4, 0]), -half - np.array([4, 0])])
    mesh = trimesh.convex.convex_hull(np.concatenate([np.column_stack([outline, np.full(34, z)]) for z in (0.0, 1.0)]))
    found = heights(mesh)
    assert (found[np.abs(mesh.face_normals[:, 1]) > 0.9999] == 0).all()
    assert found.max() == pytest.approx(1 - np.cos(np.pi / 32), rel=0.02)


def test_a_roof_and_a_box_are_flat() -> None:
    roof = trimesh.convex.convex_hull([[x, y, z] for x in (0, 5) for y, z in ((-3, 0), (3, 0), (0, 0.5), (0, -2))])
    for mesh in (roof, trimesh.creation.box([3, 2, 1])):
        assert (heights(mesh) == 0).all()


def test_a_gear_of_24_teeth_is_flat(spur_gear: trimesh.Trimesh) -> None:
    assert spur_gear.is_watertight
    assert (heights(spur_gear) == 0).all()
