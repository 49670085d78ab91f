"""The built-in parts: sizes, solidity, and exactly the symmetry that is configured."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from surface_symmetry import symmetry_residual

from attentionvote.cad.builtin import BUILTIN_PARTS, builtin_surface
from attentionvote.cad.mesh_file import largest_vertex_distance
from attentionvote.geometry.pose import rotation_about
from attentionvote.geometry.symmetry import Symmetry

NOMINAL_MM = {
    "connecting_rod": 143,
    "vertical_bearing_pedestal": 165,
    "slider_bearing_pedestal": 125,
    "brick": 37,
    "gear": 121,
    "candlestick": 191,
    "pepper": 335,
    "ring_screw": 155,
    "gear_shaft": 437,
}


def test_the_catalogue_has_the_papers_parts_at_their_size() -> None:
    assert {name: round(part.diameter * 1000) for name, part in BUILTIN_PARTS.items()} == NOMINAL_MM


@pytest.mark.parametrize("name", BUILTIN_PARTS)
def test_a_builtin_is_one_watertight_solid_of_exact_diameter(name: str) -> None:
    vertices, faces = builtin_surface(name)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert 800 <= len(faces) <= 3200
    assert largest_vertex_distance(vertices) == pytest.approx(NOMINAL_MM[name] / 1000, abs=1e-9)
    np.testing.assert_allclose(mesh.bounds.sum(0), 0, atol=1e-9)


@pytest.mark.parametrize("name", BUILTIN_PARTS)
def test_a_builtin_has_its_symmetry(name: str) -> None:
    part = BUILTIN_PARTS[name]
    # Facets: 48 sides leave r (1 - cos(pi / 48)) = 0.11 % of D at most; below 0.03 % of D the
    # measurement stops, finite symmetries are exact by construction.
    limit = 1.1e-3 if part.symmetry.is_revolution else 3e-4
    assert symmetry_residual(*builtin_surface(name), part.symmetry) < limit * part.diameter


@pytest.mark.parametrize("name", BUILTIN_PARTS)
def test_a_builtin_has_no_more_than_its_symmetry(name: str) -> None:
    vertices, faces = builtin_surface(name)
    part = BUILTIN_PARTS[name]
    for axis in np.eye(3):
        half_turn = Symmetry("cyclic", (axis[0], axis[1], axis[2]), 2)
        is_configured = part.symmetry.kind != "none" and axis[2] == 1
        if not is_configured:
            # 3 % of D is ten times what the detection forgives: nobody confuses the two sides.
            assert symmetry_residual(vertices, faces, half_turn) > 0.03 * part.diameter
    if not part.symmetry.is_revolution:
        assert symmetry_residual(vertices, faces, Symmetry("cyclic", order=4)) > 0.03 * part.diameter


def test_a_finite_symmetry_maps_the_vertices_exactly() -> None:
    vertices, _ = builtin_surface("connecting_rod")
    turned = vertices @ rotation_about((0, 0, 1), np.pi).T
    nearest = np.linalg.norm(turned[:, None] - vertices[None], axis=-1).min(1)
    assert nearest.max() < 1e-6


def test_the_stand_in_of_the_brick_is_near_the_datasets_moments() -> None:
    from attentionvote.simulation.part_files import load_part

    expected = (0.00973728, 0.00512363, 0.00341862)
    np.testing.assert_allclose(np.diag(load_part("brick", "builtin:brick").covariance_root), expected, rtol=0.01)


def test_an_unknown_builtin_names_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"'builtin:conecting_rod' must be one of .* mean 'builtin:connecting_rod'\?"):
        builtin_surface("conecting_rod")


def test_a_builtin_cannot_be_changed_by_accident() -> None:
    vertices, _ = builtin_surface("gear")
    with pytest.raises(ValueError, match="read-only"):
        vertices[0] = 0
