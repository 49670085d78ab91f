"""Distance to a surface, its nearest point and first hits, against slow references."""

from __future__ import annotations

import numpy as np
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.cad.surface_distance import SurfaceDistance


def reference(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Distance to every triangle by trimesh's closest points, in double precision; the smallest."""
    triangles = mesh.triangles  # of a size of about 1, for which trimesh's tolerances are
    nearest = [trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1))) for point in points]
    return np.linalg.norm(np.stack(nearest) - points[:, None], axis=-1).min(axis=1)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.1, 5.0]))
def test_the_distance_is_the_smallest_over_all_triangles(seed: int, size: float) -> None:
    # Long thin triangles (a fan of 40) and large ones are what a search by samples gets wrong.
    mesh = trimesh.creation.cylinder(0.3, 1.7, sections=40)
    mesh.apply_translation([3.0, -2.0, 1.0])
    points = mesh.centroid + np.random.default_rng(seed).normal(scale=0.6, size=(20, 3))
    expected = reference(points, mesh)
    surface = SurfaceDistance(mesh.vertices * size, mesh.faces)
    nearest = surface.nearest(points * size)
    np.testing.assert_allclose(surface(points * size) / size, expected, atol=3e-6)
    np.testing.assert_allclose(np.linalg.norm(nearest.point / size - points, axis=1), expected, atol=3e-6)
    on_face = trimesh.triangles.closest_point(mesh.triangles[nearest.face], nearest.point / size)
    np.testing.assert_allclose(on_face, nearest.point / size, atol=3e-6)


def test_needles_are_measured_exactly() -> None:
    # Triangles of a boolean: 98 long, .019 high. In single precision their own points lie .027 beside them.
    needle = np.array([[5.111161, -49.738075, -4.0], [9.985359, -0.540918, -4.0], [15.205162, 47.631954, -4.0]])
    roof = np.concatenate([needle, needle + np.array([0, 0, 8])])
    mesh = trimesh.convex.convex_hull(roof)
    surface = SurfaceDistance(np.array(mesh.vertices), mesh.faces)
    weights = np.random.default_rng(0).dirichlet(np.ones(3), size=200)
    assert surface(weights @ needle).max() < 1e-3


def test_rays_meet_the_near_side_and_miss_beside() -> None:
    box = trimesh.creation.box([3, 2, 1])
    surface = SurfaceDistance(np.array(box.vertices), box.faces)
    origins = np.array([[0.0, 0, 5], [1.4, 0.9, 5], [1.6, 0, 5]])
    distance, normal = surface.cast(origins, np.array([0.0, 0, -1]))
    np.testing.assert_allclose(distance, [4.5, 4.5, np.inf], atol=1e-5)
    np.testing.assert_allclose(np.abs(normal[:2]), [[0, 0, 1], [0, 0, 1]], atol=1e-6)
