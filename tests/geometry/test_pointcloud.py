"""From depth to points with normals: hand-made pictures, exact surfaces, a slow reference."""

from __future__ import annotations

import shutil
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry import native, pointcloud
from attentionvote.geometry.pointcloud import (
    back_project,
    estimate_normals,
    estimate_normals_reference,
    sample_indices,
)

CAMERA = {"fx": 500.0, "fy": 400.0, "cx": 3.5, "cy": 2.5}


def test_back_projected_points_project_to_their_pixels() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 2, (6, 8))
    points, pixels = back_project(depth, **CAMERA)
    x, y, z = points.T.astype(np.float64)
    np.testing.assert_array_equal(pixels, np.arange(48))
    # float32 points of 2 m and a focal length of 500 pixels: an error of 1e-7 m is 1e-4 pixels.
    np.testing.assert_allclose(CAMERA["fx"] * x / z + CAMERA["cx"], pixels % 8, atol=1e-4)
    np.testing.assert_allclose(CAMERA["fy"] * y / z + CAMERA["cy"], pixels // 8, atol=1e-4)
    np.testing.assert_allclose(z, depth.reshape(-1), rtol=1e-6)


def test_missing_depth_gives_no_points() -> None:
    depth = np.array([[0.0, np.nan, 1.0], [np.inf, 2.0, -0.0]])
    points, pixels = back_project(depth, **CAMERA)
    np.testing.assert_array_equal(pixels, [2, 4])
    np.testing.assert_array_equal(points[:, 2], [1, 2])
    assert back_project(np.zeros((2, 2)), **CAMERA)[0].shape == (0, 3)


@pytest.mark.parametrize(
    ("depth", "change", "words"),
    [
        (np.ones(4), {}, r"depth must be an image \(H, W\), got shape \(4,\)"),
        (np.array([[1.0, -0.25]]), {}, r"depth must not be negative, got -0\.25 m"),
        (np.ones((2, 2)), {"fx": 0.0}, "focal lengths must be positive pixels, got fx 0.0 and fy 400.0"),
        (np.ones((2, 2)), {"fy": float("nan")}, "focal lengths must be positive pixels"),
    ],
)
def test_impossible_pictures_are_refused(depth: np.ndarray, change: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        back_project(depth, **{**CAMERA, **change})


def slow_normals(points: np.ndarray, query: np.ndarray, neighbors: int) -> np.ndarray:
    """All distances, one singular value decomposition a point."""
    result = []
    for q in query.astype(np.float64):
        near = points[np.argsort(np.linalg.norm(points - q, axis=1))[:neighbors]].astype(np.float64)
        normal = np.linalg.svd(near - near.mean(0))[2][-1]
        result.append(-normal if normal @ q > 0 else normal)
    return np.array(result)


@given(st.integers(0, 1000))
def test_normals_equal_the_slow_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # A curved patch 0.6 m away, 0.2 mm of noise.
    xy = rng.uniform(-0.05, 0.05, (150, 2))
    points = np.c_[xy, 0.6 + 2 * (xy**2).sum(1) + rng.normal(0, 2e-4, 150)].astype(np.float32)
    normals = estimate_normals(points, points[:20], neighbors=25)
    assert normals.dtype == np.float32
    cosine = (normals * slow_normals(points, points[:20], 25)).sum(1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.05  # float32 answers resolve about 0.03 degrees


def clouds(kind: str, seed: int, count: int) -> np.ndarray:
    """Points half a metre away."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.1, 0.1, (count, 3)) + np.array([0, 0, 0.5])
    if kind == "sheet":  # as a sensor gives it
        points[:, 2] = 0.5 + 0.2 * np.sin(20 * points[:, 0]) * points[:, 1] + rng.normal(0, 2e-4, count)
    elif kind == "stray":  # boxes of the search grow far too large
        points[:: max(2, count // 3)] += [30.0, -20.0, 100.0]
    elif kind == "repeated":  # more points at one place than neighbours
        points = points[rng.integers(0, max(1, count // 20), count)] + rng.integers(0, 2, (count, 3)) * 1e-4
    return points.astype(np.float32)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
@given(st.sampled_from(["uniform", "sheet", "stray"]), st.integers(0, 1000), st.integers(3, 400), st.integers(3, 40))
def test_the_c_code_equals_its_reference(kind: str, seed: int, count: int, neighbors: int) -> None:
    assert native.load("attentionvote.geometry", "normals.c") is not None
    points = clouds(kind, seed, count)
    query = np.concatenate([points[: count // 2], clouds("uniform", seed + 1, 20)])
    actual = estimate_normals(points, query, neighbors).astype(np.float64)
    expected = estimate_normals_reference(points, query, min(neighbors, count)).astype(np.float64)
    # Two directions of equal variance have no answer: what counts is the variance along the normal.
    apart = np.linalg.norm(np.cross(actual, expected), axis=1)
    for q in np.flatnonzero(apart > 2e-4):
        variance = np.sort(variances(points, query[q], neighbors))
        assert variance[1] - variance[0] < 1e-5 * variance[2]


@pytest.mark.parametrize("size", [1e-30, 1e15, 3e38])
def test_clouds_of_any_size_have_normals(size: float) -> None:
    points = (clouds("sheet", 0, 100).astype(np.float64) * size).astype(np.float32)
    points[::7] = size * 2e-7
    normals = estimate_normals(points, None, 10)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def variances(points: np.ndarray, query: np.ndarray, neighbors: int) -> np.ndarray:
    """Of the nearest points, along their principal directions; of equally far points those with the lowest index."""
    squared = ((points.astype(np.float64) - query.astype(np.float64)) ** 2).sum(1)
    near = points[np.argsort(squared, kind="stable")[:neighbors]].astype(np.float64)
    near -= near.mean(0)
    return np.linalg.eigvalsh(near.T @ near)


@given(st.integers(0, 1000), st.integers(30, 600))
def test_of_equally_far_points_the_first_are_taken(seed: int, count: int) -> None:
    lattice = (np.random.default_rng(seed).integers(0, 6, (count, 3)) * 0.0078125 + [0, 0, 0.5]).astype(np.float32)
    for points in (lattice, clouds("repeated", seed, count)):
        normals = estimate_normals(points, points[:20], 20).astype(np.float64)
        for normal, query in zip(normals, points[:20], strict=True):
            squared = ((points.astype(np.float64) - query) ** 2).sum(1)
            near = points[np.argsort(squared, kind="stable")[:20]].astype(np.float64)
            along = (((near - near.mean(0)) @ normal) ** 2).sum()
            smallest = variances(points, query, 20)
            assert abs(along - smallest[0]) <= 1e-6 * smallest[2] + 1e-15
        assert ((normals * points[:20]).sum(1) <= 1e-7).all()


def test_normals_of_a_sphere_are_its_radii_and_look_at_the_camera() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(6000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction[direction[:, 2] < -0.3]  # the side that the camera sees
    points = (np.array([0, 0, 0.5]) + 0.1 * direction).astype(np.float32)
    normals = estimate_normals(points)
    inner = direction[:, 2] < -0.5  # away from the border, where a neighbourhood is one-sided
    angle = np.degrees(np.arccos(np.clip((normals * direction).sum(1), -1, 1)))[inner]
    assert angle.max() < 5  # 30 of 2000 points: a neighbourhood spans about 14 degrees of the sphere
    assert angle.mean() < 1.5
    assert ((normals * points).sum(1) <= 0).all()


def test_all_points_are_neighbours_when_there_are_few() -> None:
    triangle = np.float32([[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]])
    np.testing.assert_allclose(estimate_normals(triangle), np.tile([0, 0, -1], (3, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("points", "query", "words"),
    [
        (np.zeros((2, 3), np.float32), None, "normals need at least 3 points, got 2"),
        (np.zeros((0, 3), np.float32), None, "normals need at least 3 points, got 0"),
        (np.full((4, 3), np.nan, np.float32), None, "points must be finite, got 4 with NaN or inf"),
        (np.zeros((4, 2), np.float32), None, r"points must have shape \(P, 3\), got \(4, 2\)"),
        (np.ones((4, 3), np.float32), np.ones((1, 2), np.float32), r"query must have shape \(P, 3\), got \(1, 2\)"),
    ],
)
def test_impossible_clouds_are_refused(points: np.ndarray, query: np.ndarray | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        estimate_normals(points, query)


@given(st.integers(1, 50), st.integers(1, 80), st.integers(0, 1000))
def test_sampling_repeats_only_when_it_must(available: int, count: int, seed: int) -> None:
    index = sample_indices(available, count, np.random.default_rng(seed))
    assert len(index) == count
    assert len(np.unique(index)) == min(available, count)
    assert index.min() >= 0
    assert index.max() < available
    np.testing.assert_array_equal(index, sample_indices(available, count, np.random.default_rng(seed)))


def test_nothing_can_be_sampled_from_an_empty_cloud() -> None:
    with pytest.raises(ValueError, match="cannot sample from an empty cloud"):
        sample_indices(0, 3, np.random.default_rng(0))


def test_places_that_are_repeated_take_no_longer() -> None:
    """A sensor or a file that writes a few places many times over must not keep a cell busy for seconds."""
    rng = np.random.default_rng(4)
    places = rng.normal(size=(20, 3)).astype(np.float32) * np.float32(0.1) + np.float32([0, 0, 1])
    cloud = places[np.r_[np.zeros(20_000, int), rng.integers(0, 20, 2000)]]
    begun = time.process_time()
    normals = estimate_normals(cloud, cloud, 30)
    assert time.process_time() - begun < 0.5  # every query by itself takes some seconds
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    few = np.repeat(places, 4, axis=0)
    expected = estimate_normals_reference(few, few, 30)
    np.testing.assert_allclose(np.abs((estimate_normals(few, few, 30) * expected).sum(axis=1)), 1, atol=1e-5)


def test_an_image_of_many_rows_is_projected_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    depth = np.where(rng.random((301, 7)) < 0.2, np.nan, rng.uniform(0.5, 2, (301, 7)))
    points, pixels = back_project(depth, **CAMERA)
    monkeypatch.setattr(pointcloud, "_ROWS", 1000)
    whole, places = back_project(depth, **CAMERA)
    np.testing.assert_array_equal(points, whole)
    np.testing.assert_array_equal(pixels, places)
    assert len(back_project(np.zeros((0, 7)), **CAMERA)[0]) == 0


def test_normals_are_open3ds() -> None:
    # A wavy sheet, noisy, seen from the origin: an implementation that shares no line with either of ours.
    from open3d import geometry, utility

    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.2, 0.2, size=(2, 4000))
    points = np.stack([x, y, 0.8 + 0.05 * np.sin(20 * x) * np.cos(15 * y)], axis=1) + rng.normal(
        scale=2e-4, size=(4000, 3)
    )
    points = points.astype(np.float32)
    cloud = geometry.PointCloud(utility.Vector3dVector(points.astype(np.float64)))
    cloud.estimate_normals(geometry.KDTreeSearchParamKNN(30), fast_normal_computation=False)
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    cosine = np.einsum("ni,ni->n", estimate_normals(points, neighbors=30), np.asarray(cloud.normals))
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1
