"""Distance to a surface and to its turned self, against slow references."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.cad.surface_distance import RotationCheck, SurfaceDistance, point_triangle_distance
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, rotation_about


def reference(point: np.ndarray, triangle: np.ndarray) -> float:
    """Projected onto the plane, then the edges: the best of a fine barycentric grid, and its neighbourhood."""
    low, high, best = np.zeros(2), np.ones(2), np.inf
    for _ in range(12):
        u, v = np.meshgrid(np.linspace(low[0], high[0], 21), np.linspace(low[1], high[1], 21), indexing="ij")
        v = np.minimum(v, 1 - u)
        hits = triangle[0] + u[..., None] * (triangle[1] - triangle[0]) + v[..., None] * (triangle[2] - triangle[0])
        distance = np.linalg.norm(hits - point, axis=-1)
        i = np.unravel_index(distance.argmin(), distance.shape)
        best, middle, half = min(best, distance[i]), np.array([u[i], v[i]]), (high - low) / 5
        low, high = np.clip(middle - half, 0, 1), np.clip(middle + half, 0, 1)
    return float(best)


@given(st.integers(0, 2**32 - 1))
def test_point_triangle_distance_is_the_references(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, triangles = rng.normal(size=(4, 3)), rng.normal(size=(4, 3, 3))
    expected = [reference(p, t) for p, t in zip(points, triangles, strict=True)]
    np.testing.assert_allclose(point_triangle_distance(points, triangles), expected, atol=1e-4)


def test_a_degenerate_triangle_is_its_segment() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]]])
    distance = point_triangle_distance(np.array([[1.5, 3, 0], [0, 3, 4]]), triangle)
    np.testing.assert_allclose(distance, [3, 5])


def test_the_distance_is_the_smallest_over_all_triangles() -> None:
    # Long thin triangles (a fan of 40) and large ones are what a search by samples gets wrong.
    mesh = trimesh.creation.cylinder(0.3, 1.7, sections=40)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(scale=0.5, size=(60, 3)), mesh.vertices[::4], mesh.sample(60, seed=1)])
    triangles = mesh.vertices[mesh.faces]
    each = point_triangle_distance(np.repeat(points, len(triangles), 0), np.tile(triangles, (len(points), 1, 1)))
    expected = each.reshape(len(points), -1).min(1)
    np.testing.assert_allclose(SurfaceDistance(mesh.vertices, mesh.faces)(points), expected, atol=1e-12)
    surface = SurfaceDistance(mesh.vertices, mesh.faces)
    relaxed = surface(points, (0.01, 0.1))
    is_between = (expected > 0.01) & (expected < 0.1)
    np.testing.assert_allclose(relaxed[is_between], expected[is_between], atol=1e-12)
    assert (relaxed[expected <= 0.01] <= 0.01 + 1e-12).all()
    assert (relaxed[expected >= 0.1] >= 0.1).all()
    assert surface.largest(points, 0.0, np.inf) == pytest.approx(expected.max(), abs=1e-12)
    assert surface.largest(points[expected < 0.05], 0.01, 0.1) == pytest.approx(expected[expected < 0.05].max())
    assert surface.largest(points[expected < 0.05], 0.06, 0.1) == 0.06


@pytest.fixture(scope="module")
def box_check() -> RotationCheck:
    box = trimesh.creation.box([3, 2, 1])
    return RotationCheck(box.vertices, box.faces, tolerance=0.01)


def test_residuals_are_the_distance_the_corners_move(box_check: RotationCheck) -> None:
    assert box_check.residual(rotation_about((0, 0, 1), np.pi)) <= 1e-4  # nothing below 1 % of the tolerance matters
    # A quarter turn about z carries the corner (1.5, 1) to (-1, 1.5), half a unit outside of y = 1.
    assert box_check.residual(rotation_about((0, 0, 1), np.pi / 2)) == pytest.approx(0.5, abs=0.1)
    # A small turn moves the corner by angle * radius, of which the part along the face's normal counts.
    tilt = 0.008
    outside = np.sin(tilt) * 1.5 - (1 - np.cos(tilt)) * 1
    assert box_check.residual(rotation_about((0, 0, 1), tilt)) == pytest.approx(outside, rel=1e-3)


def test_a_group_holds_only_when_every_element_does(box_check: RotationCheck) -> None:
    half_turns = np.stack([rotation_about(u, np.pi) for u in np.eye(3)])
    assert box_check.holds(half_turns)
    assert not box_check.holds(np.concatenate([half_turns, rotation_about((0, 0, 1), 0.1)[None]]))
    assert box_check.worst(np.concatenate([half_turns, rotation_about((0, 0, 1), np.pi / 2)[None]])) > 0.3


def test_refinement_finds_the_symmetry_nearby(box_check: RotationCheck) -> None:
    rng = np.random.default_rng(3)
    for axis in np.eye(3):
        exact = rotation_about(axis, np.pi)
        start = matrix_from_quaternion(random_quaternion(rng) * [0, 0.05, 0.05, 0.05] + [1, 0, 0, 0]) @ exact
        assert np.abs(start - exact).max() > 0.01
        np.testing.assert_allclose(box_check.refined(start), exact, atol=1e-3)
