"""Instanced ray casting against brute force over every triangle."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, inverse, rotation_about, transform
from attentionvote.part import Part
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.raycast import BinSurface, PartCaster

Heap = Callable[..., NDArray]
ORIGIN = np.zeros(3)


def random_rays(count: int, seed: int, half: float = 0.15) -> NDArray:
    return np.random.default_rng(seed).uniform(-half, half, size=(count, 2))


def with_z(xy: NDArray) -> NDArray:
    return np.c_[xy, np.ones(len(xy))]


@pytest.mark.parametrize("count", [1, 7])
def test_first_hits_equal_brute_force(
    bracket: Part, caster: PartCaster, heap: Heap, slow: SimpleNamespace, count: int
) -> None:
    poses, xy = heap(count, seed=count), random_rays(1500, seed=1)
    hits = caster.cast(poses, xy)
    triangles = slow.posed(bracket, poses).reshape(-1, 3, 3)
    depth, triangle = slow.cast(ORIGIN, with_z(xy), triangles)
    agree = np.isfinite(depth) == (hits.instance >= 0)
    assert agree.mean() > 0.998  # rays along an edge may go either way
    hit = agree & np.isfinite(depth)
    assert hit.sum() > 50
    np.testing.assert_allclose(hits.depth[hit], depth[hit], atol=2e-6)
    owner = triangle // len(bracket.faces)
    assert (owner == hits.instance)[hit].mean() > 0.998
    a, b, c = np.moveaxis(triangles[triangle[hit]], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert (np.einsum("pi,pi->p", normal, hits.normal[hit]) > 1 - 1e-9).mean() > 0.99
    assert np.isinf(hits.depth[hits.instance < 0]).all()
    assert (hits.normal[hits.instance < 0] == 0).all()


def test_normals_are_unit_vectors_towards_the_camera(caster: PartCaster, heap: Heap) -> None:
    xy = random_rays(4000, seed=2)
    hits = caster.cast(heap(8), xy)
    hit = hits.instance >= 0
    np.testing.assert_allclose(np.linalg.norm(hits.normal[hit], axis=1), 1, atol=1e-12)
    assert (np.einsum("pi,pi->p", hits.normal[hit], with_z(xy[hit])) <= 0).all()


def test_without_normals_the_rest_is_the_same(caster: PartCaster, heap: Heap) -> None:
    xy = random_rays(4000, seed=2)
    with_them, without = (caster.cast(heap(8), xy, normals=asked) for asked in (True, False))
    np.testing.assert_array_equal(with_them.depth, without.depth)
    np.testing.assert_array_equal(with_them.instance, without.instance)
    assert (without.normal == 0).all()
    assert (with_them.normal != 0).any()


def test_an_open_surface_turns_its_normals_too(bracket: Part, heap: Heap) -> None:
    inside_out = Part("inside_out", bracket.vertices, bracket.faces[:, ::-1], bracket.diameter)
    xy = random_rays(500, seed=2)
    expected, actual = PartCaster(bracket).cast(heap(2), xy), PartCaster(inside_out).cast(heap(2), xy)
    np.testing.assert_allclose(actual.normal, expected.normal, atol=1e-12)


def test_no_instances_and_no_rays(caster: PartCaster) -> None:
    assert (caster.cast(np.zeros((0, 4, 4)), random_rays(5, 0)).instance == -1).all()
    assert caster.cast(transform(np.eye(3), (0, 0, 0.4))[None], np.zeros((0, 2))).depth.shape == (0,)


def test_an_instance_behind_the_camera_is_refused(caster: PartCaster) -> None:
    with pytest.raises(ValueError, match="every instance must lie in front of the camera, one reaches z <= 0"):
        caster.cast(np.eye(4)[None], random_rays(5, 0))


def bin_triangles(surface: BinSurface) -> NDArray:
    x, y, z = surface.size * (0.5, 0.5, 1.0)
    corners = np.array([[sx * x, sy * y, h] for h in (0.0, z) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    c = apply(surface.camera_from_bin, corners)
    quads = [(0, 1, 2, 3), *((i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4) for i in range(4))]
    return np.array([[c[q[0]], c[q[i]], c[q[i + 1]]] for q in quads for i in (1, 2)])


@pytest.mark.parametrize("seed", range(6))
def test_the_bin_equals_its_triangles(slow: SimpleNamespace, seed: int) -> None:
    """Also from outside the opening, where the near wall hides the floor."""
    rng = np.random.default_rng(seed)
    turn = rotation_about((1, 0, 0), np.pi + rng.uniform(-0.9, 0.9)) @ rotation_about((0, 0, 1), rng.uniform(-3, 3))
    surface = BinSurface(np.array([0.3, 0.2, 0.1]), transform(turn, (*rng.uniform(-0.1, 0.1, 2), 0.6)))
    xy = random_rays(2000, seed, half=0.5)
    expected, _ = slow.cast(ORIGIN, with_z(xy), bin_triangles(surface))
    depth = surface.depth(xy)
    assert 100 < np.isfinite(expected).sum() < 2000
    same = np.isfinite(expected) == np.isfinite(depth)
    assert same.mean() > 0.998
    both = same & np.isfinite(expected)
    np.testing.assert_allclose(depth[both], expected[both], rtol=1e-9)
    shift = np.array([0.05, -0.02, 0.01])
    expected, _ = slow.cast(shift, with_z(xy), bin_triangles(surface))
    np.testing.assert_allclose(np.isfinite(surface.moved(shift).depth(xy)), np.isfinite(expected))


def test_the_bin_hides_parts_behind_its_wall_but_not_those_pressed_into_its_floor(
    bracket: Part, caster: PartCaster
) -> None:
    centre = np.zeros((1, 2))
    pose = transform(np.eye(3), (0, 0, 0.4))[None]
    top = caster.cast(pose, centre).depth[0]
    for floor, visible in ((top - 0.001 * bracket.diameter, True), (top - 0.02 * bracket.diameter, False)):
        surface = BinSurface(np.array([0.3, 0.3, 0.1]), transform(np.diag([1.0, -1, -1]), (0, 0, floor)))
        hits = caster.cast(pose, centre, surface)
        assert (hits.instance[0] == 0) == visible
        assert hits.depth[0] == pytest.approx(top if visible else floor)
        without = caster.cast(pose, centre + 0.14, surface, background=False)
        assert np.isinf(without.depth[0])


def test_blocked_points_are_those_a_ray_does_not_reach(
    bracket: Part, caster: PartCaster, heap: Heap, slow: SimpleNamespace
) -> None:
    poses = heap(5, seed=3)
    rng = np.random.default_rng(0)
    points = np.concatenate([apply(pose, bracket.surface_points(100, rng)) for pose in poses])
    expected, _ = slow.cast(ORIGIN, points, slow.posed(bracket, poses).reshape(-1, 3, 3))
    blocked = caster.blocked(poses, points, 1e-5, None)
    assert 0.2 < blocked.mean() < 0.8
    # Parameter 1 is the point itself.
    assert (blocked == (expected * points[:, 2] < points[:, 2] - 1e-5)).mean() > 0.995


CAMERA = Camera(320, 240, 400.0, 400.0, 160.0, 120.0)


def full_visibility(caster: PartCaster, poses: NDArray, camera: Camera, surface: BinSurface | None) -> NDArray:
    """By definition: pixels that show the instance over the pixels of its silhouette, on a picture twice as large."""
    v, u = np.mgrid[-120:360, -160:480]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.rays(pixels)
    inside = ((pixels >= 0) & (pixels < (320, 240))).all(axis=1)
    owner = caster.cast(poses, rays, surface).instance
    alone = [(caster.cast(pose[None], rays).instance >= 0).sum() for pose in poses]
    return np.array([((owner == i) & inside).sum() for i in range(len(poses))]) / alone


@pytest.mark.parametrize("with_bin", [False, True])
def test_visible_fraction_is_the_share_of_the_silhouette(caster: PartCaster, heap: Heap, with_bin: bool) -> None:
    poses = heap(8, seed=5)
    poses[0, :2, 3] = (0.16, 0.0)  # across the right border of the picture
    surface = BinSurface(np.array([0.11, 0.2, 0.16]), transform(np.diag([1.0, -1, -1]), (0, 0, 0.5)))
    expected = full_visibility(caster, poses, CAMERA, surface if with_bin else None)
    actual = caster.visible_fraction(poses, CAMERA, surface if with_bin else None, stride=1)
    np.testing.assert_allclose(actual, expected, atol=1e-3)
    assert 0.05 < actual.min() < 0.7
    coarse = caster.visible_fraction(poses, CAMERA, surface if with_bin else None, stride=3)
    np.testing.assert_allclose(coarse, expected, atol=0.05)


def test_a_part_half_outside_the_picture_is_half_visible(caster: PartCaster) -> None:
    pose = transform(rotation_about((1, 0, 0), np.pi / 2), (0.16, 0.0, 0.4))[None]
    edge = apply(inverse(pose[0]), np.array([[0.16, 0.0, 0.4]]))
    assert np.linalg.norm(edge) < 1e-12  # the part's origin lies on the border
    share = caster.visible_fraction(pose, CAMERA, None, stride=1)[0]
    area_left = 0.008 * 0.03 + 0.032 * 0.008  # the bracket's profile left of its origin
    area = 0.06 * 0.008 + 0.032 * 0.008
    assert share == pytest.approx(area_left / area, abs=0.05)
    assert caster.visible_fraction(transform(np.eye(3), (3, 0, 0.4))[None], CAMERA, None)[0] == 0


def test_the_pixel_box_holds_the_pile(caster: PartCaster, heap: Heap) -> None:
    poses = heap(5)
    u0, u1, v0, v1 = caster.pixel_box(poses, CAMERA)
    v, u = np.mgrid[0:240, 0:320]
    hit = caster.cast(poses, CAMERA.rays(np.stack([u.ravel(), v.ravel()], axis=1))).instance.reshape(240, 320) >= 0
    rows, columns = np.nonzero(hit)
    assert (u0, u1, v0, v1) == pytest.approx((columns.min(), columns.max(), rows.min(), rows.max()), abs=2)
    assert u0 <= columns.min() <= columns.max() <= u1
    assert v0 <= rows.min() <= rows.max() <= v1
