"""Camera intrinsics and where the camera stands."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import apply, inverse
from attentionvote.simulation.camera import Camera, CameraSettings


@given(st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(0.2, 3))
def test_a_ray_passes_through_the_point_it_was_projected_from(x: float, y: float, z: float) -> None:
    camera = Camera()
    ray = camera.rays(camera.project([x, y, z])[None])[0]
    np.testing.assert_allclose(ray * z, (x, y), atol=1e-12)


def test_the_principal_point_looks_straight_ahead() -> None:
    np.testing.assert_array_equal(Camera().rays([[516.0, 386.0]]), [[0.0, 0.0]])
    np.testing.assert_allclose(Camera().rays([[516.0 + 1700, 386.0]]), [[1.0, 0.0]])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.037, 0.143, 0.437]))
def test_the_camera_looks_down_at_the_bin(seed: int, diameter: float) -> None:
    settings, height = CameraSettings(), diameter
    camera_from_bin = settings.sample(diameter, height, np.random.default_rng(seed))
    rotation = camera_from_bin[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    # Depth grows towards the floor, and the viewing axis leans by no more than the tilt.
    assert -rotation[2, 2] >= np.cos(np.radians(6.0)) - 1e-12
    nominal = 0.80 * diameter / 0.143
    target = apply(camera_from_bin, np.array([[0, 0, height / 3]]))[0]
    assert 0.9 * nominal < target[2] < 1.1 * nominal
    # Within the shift plus nothing else: the bin's middle stays in the middle of the picture.
    assert np.linalg.norm(target[:2]) <= 1.09 * 0.015 * np.sqrt(2) * nominal
    # x of the picture stays within the roll of the bin's x.
    assert np.degrees(np.arctan2(abs(rotation[0, 1]), rotation[0, 0])) <= 15.5


def test_without_jitter_the_camera_stands_over_the_middle() -> None:
    settings = CameraSettings(distance=0.7, distance_jitter=0, shift=0, tilt_degrees=0, roll_degrees=0)
    pose = inverse(settings.sample(0.1, 0.3, np.random.default_rng(0)))
    np.testing.assert_allclose(pose[:3, 3], (0, 0, 0.8))
    np.testing.assert_allclose(pose[:3, :3], np.diag([1, -1, -1]), atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera(fx=0), "^fx must be greater than 0 and at most 1000000; got 0"),
        (lambda: Camera(width=-3), "^width must be at least 8 and at most 16384; got -3"),
        (lambda: CameraSettings(distance=0), "^distance must be a number greater than 0 and at most 100; got 0"),
        (lambda: CameraSettings(tilt_degrees=70), "^tilt_degrees must be at least 0 and at most 60; got 70"),
    ],
)
def test_impossible_cameras(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
