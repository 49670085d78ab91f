"""The conventions of the package's docstring, each held by one test that is wrong under the other convention."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import attentionvote
from attentionvote.geometry import pose, sampling
from attentionvote.geometry.pointcloud import back_project, estimate_normals, sample_indices
from attentionvote.geometry.pose import apply, matrix_from_quaternion, rotation_about, transform
from attentionvote.part import Part


def test_quaternions_are_scalar_first() -> None:
    np.testing.assert_array_equal(matrix_from_quaternion([1, 0, 0, 0]), np.eye(3))
    quarter_about_z = matrix_from_quaternion([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(quarter_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_target_from_source_takes_points_of_the_source_to_the_target() -> None:
    # The part stands half a metre in front of the camera, turned so that its x points down in the image.
    camera_from_part = transform(rotation_about([0, 0, 1], np.pi / 2), [0, 0, 0.5])
    np.testing.assert_allclose(apply(camera_from_part, [[0.1, 0, 0]]), [[0, 0.1, 0.5]], atol=1e-15)


def test_camera_frame_is_x_right_y_down_z_forward() -> None:
    depth = np.zeros((4, 6))
    depth[3, 5] = 2.0  # the lowest row, the rightmost column
    points, pixels = back_project(depth, fx=10, fy=10, cx=2.5, cy=1.5)
    np.testing.assert_allclose(points, [[0.5, 0.3, 2.0]], atol=1e-7)
    np.testing.assert_array_equal(pixels, [3 * 6 + 5])


def test_normals_look_at_the_camera() -> None:
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(-0.1, 0.1, (200, 2)), np.full(200, 0.5)].astype(np.float32)
    np.testing.assert_allclose(estimate_normals(wall), np.tile([0, 0, -1], (200, 1)), atol=1e-5)


def test_lengths_are_metres() -> None:
    # A millimetre cube has an area of 6e-6 square metres, and its moment matrix is in metres, not millimetres.
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 1e-3
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])
    part = Part("cube", corners, faces, diameter=np.sqrt(3) * 1e-3)
    np.testing.assert_allclose(part.covariance_root, np.eye(3) * np.sqrt(5 / 36) * 1e-3, atol=1e-15)


def test_ball_query_returns_the_first_in_index_order_and_not_the_nearest() -> None:
    points = np.float32([[0.9, 0, 0], [0.5, 0, 0], [5, 0, 0], [0.1, 0, 0]])
    indices, found = sampling.ball_query(points, np.zeros((1, 3), np.float32), radius=1.0, count=2)
    np.testing.assert_array_equal(indices, [[0, 1]])
    np.testing.assert_array_equal(found, [2])


@pytest.mark.parametrize("function", [pose.random_quaternion, Part.surface_points, sample_indices])
def test_random_functions_take_an_explicit_generator(function: object) -> None:
    parameter = inspect.signature(function).parameters["rng"]  # type: ignore[arg-type]
    assert parameter.default is inspect.Parameter.empty


def test_the_conventions_are_stated_in_the_package() -> None:
    text = attentionvote.__doc__ or ""
    for word in ("metres", "(w, x, y, z)", "target_from_source", "x right, y down, z forward", "rng", "channels last"):
        assert word in text
