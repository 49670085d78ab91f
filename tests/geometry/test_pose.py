"""Poses against scipy's Rotation, over the whole of SO(3) and at its awkward corners."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from attentionvote.geometry.pose import (
    apply,
    canonical_quaternion,
    inverse,
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_quaternion,
    rotation_about,
    rotation_angle,
    transform,
)

SEEDS = st.integers(0, 2**31)


def scipy_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Scipy's answer; its quaternions are scalar last unless told."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


@given(arrays(np.float64, (3, 4), elements=st.floats(-10, 10)).filter(lambda q: np.linalg.norm(q, axis=1).min() > 1e-3))
def test_matrix_from_quaternion_equals_scipy_for_any_length(quaternion: np.ndarray) -> None:
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), scipy_matrix(quaternion), atol=1e-12)


@given(SEEDS)
def test_quaternion_and_matrix_are_inverse(seed: int) -> None:
    q = random_quaternion(np.random.default_rng(seed), (2, 5))
    np.testing.assert_allclose(quaternion_from_matrix(matrix_from_quaternion(q)), q, atol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 1), (1e-9, 1, 0)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, np.pi / 2, np.pi - 1e-9, np.pi, np.pi + 1e-9])
def test_quaternion_from_matrix_is_accurate_near_half_turns(axis: tuple[float, ...], angle: float) -> None:
    rotation = Rotation.from_rotvec(angle * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()
    q = quaternion_from_matrix(rotation)
    np.testing.assert_allclose(scipy_matrix(q), rotation, atol=1e-14)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-14)


@given(arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.abs(q).max() > 1e-6))
def test_canonical_quaternion_is_the_same_for_both_signs(quaternion: np.ndarray) -> None:
    canonical = canonical_quaternion(quaternion)
    np.testing.assert_array_equal(canonical, canonical_quaternion(-quaternion))
    assert canonical[np.abs(canonical) > 1e-12][0] > 0
    assert np.array_equal(np.abs(canonical), np.abs(quaternion))


def test_canonical_quaternion_of_half_turns_has_a_positive_first_component() -> None:
    np.testing.assert_array_equal(canonical_quaternion([0.0, -1.0, 0.0, 0.0]), [0, 1, 0, 0])
    np.testing.assert_array_equal(canonical_quaternion([0.0, 0.0, -0.6, 0.8]), [0, 0, 0.6, -0.8])


def test_random_quaternions_are_uniform_on_so3() -> None:
    # The angle of a uniform rotation has density (1 - cos a) / pi; its mean is pi/2 + 2/pi. The mean of 20,000 has a
    # standard deviation of 0.0046, the bound is four of them.
    q = random_quaternion(np.random.default_rng(0), (20_000,))
    angle = rotation_angle(matrix_from_quaternion(q), np.eye(3))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.02)
    # ... and the image of any fixed direction is uniform on the sphere: mean 0, second moment 1/3.
    image = matrix_from_quaternion(q)[:, :, 2]
    np.testing.assert_allclose(image.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(image.T @ image / len(image), np.eye(3) / 3, atol=0.02)


@given(SEEDS, st.floats(-10, 10))
def test_rotation_about_equals_scipy(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    expected = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    np.testing.assert_allclose(rotation_about(axis, angle), expected, atol=1e-12)


def test_rotation_about_takes_a_batch_of_angles() -> None:
    angles = np.linspace(0, 6, 7)
    turns = rotation_about([0, 0, 2], angles)
    np.testing.assert_allclose(turns, np.stack([rotation_about([0, 0, 1], a) for a in angles]), atol=1e-15)


# float64 keeps the product of two rotations to about 1e-15; an angle of 1e-7 read off the trace would be lost.
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 0.1, 3.0, np.pi])
def test_rotation_angle_is_accurate_from_zero_to_a_half_turn(angle: float) -> None:
    a = matrix_from_quaternion(random_quaternion(np.random.default_rng(1)))
    b = a @ rotation_about([1, 2, 3], angle)
    assert rotation_angle(a, b) == pytest.approx(angle, abs=1e-14 if angle < 1 else 1e-7)


@given(SEEDS)
def test_transforms_compose_and_invert_as_their_names_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera_from_bin, bin_from_part = (
        transform(matrix_from_quaternion(random_quaternion(rng, (4,))), rng.normal(size=(4, 3))) for _ in range(2)
    )
    p_part = rng.normal(size=(4, 6, 3))
    camera_from_part = camera_from_bin @ bin_from_part
    p_camera = apply(camera_from_part, p_part)
    np.testing.assert_allclose(p_camera, apply(camera_from_bin, apply(bin_from_part, p_part)), atol=1e-12)
    np.testing.assert_allclose(apply(inverse(camera_from_part), p_camera), p_part, atol=1e-12)
    np.testing.assert_allclose(inverse(camera_from_part), np.linalg.inv(camera_from_part), atol=1e-12)
    homogeneous = np.concatenate([p_part, np.ones((4, 6, 1))], -1) @ np.swapaxes(camera_from_part, -1, -2)
    np.testing.assert_allclose(p_camera, homogeneous[..., :3], atol=1e-12)


def test_transform_broadcasts_one_rotation_over_many_translations() -> None:
    poses = transform(np.eye(3), np.arange(6.0).reshape(2, 3))
    assert poses.shape == (2, 4, 4)
    np.testing.assert_array_equal(poses[:, 3], [[0, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(poses[1, :3, 3], [3, 4, 5])
