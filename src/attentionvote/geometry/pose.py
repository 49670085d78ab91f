"""Rotations and rigid transforms: quaternions are ``(w, x, y, z)``, transforms are 4x4.

Every function accepts leading batch dimensions and returns float64 unless said otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
# Sileane's own matrices are orthonormal to 2.6e-6, float32 stays far below this; a mistake does not.
ROTATION_TOLERANCE = 1e-3


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrices ``(..., 3, 3)`` of quaternions ``(..., 4)``; any non-zero length is accepted."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Unit quaternions ``(..., 4)`` of rotation matrices ``(..., 3, 3)``, canonical sign.

    Of the four classical formulas the one with the largest divisor is taken (Shepperd 1978), so the
    result is accurate for every angle.
    """
    r = np.asarray(rotation, dtype=np.float64)
    r00, r11, r22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1], r[..., 0, 2], r[..., 1, 0]
    d, e, f = r[..., 1, 2], r[..., 2, 0], r[..., 0, 1]
    candidates = np.stack(
        [
            np.stack([1 + r00 + r11 + r22, a - d, b - e, c - f], axis=-1),
            np.stack([a - d, 1 + r00 - r11 - r22, c + f, b + e], axis=-1),
            np.stack([b - e, c + f, 1 - r00 + r11 - r22, a + d], axis=-1),
            np.stack([c - f, b + e, a + d, 1 - r00 - r11 + r22], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    return canonical_quaternion(q / np.linalg.norm(q, axis=-1, keepdims=True))


def canonical_quaternion(quaternion: ArrayLike) -> Array:
    """The one of ``q`` and ``-q`` whose first non-zero component is positive.

    Eq. (6) of the paper is sensitive to the sign, so the sign belongs to the label: this is the one
    place that fixes it.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    first = np.argmax(np.abs(q) > 1e-12, axis=-1)
    sign = np.sign(np.take_along_axis(q, first[..., None], axis=-1))
    return q * np.where(sign == 0, 1.0, sign)


def random_quaternion(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Array:
    """Quaternions ``(*shape, 4)`` uniform on SO(3)."""
    q = rng.normal(size=(*shape, 4))
    return canonical_quaternion(q / np.linalg.norm(q, axis=-1, keepdims=True))


def rotation_about(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Rotation matrices ``(..., 3, 3)`` about ``axis`` ``(3,)`` by ``angle`` ``(...)`` radians."""
    u = np.asarray(axis, dtype=np.float64)
    u = u / np.linalg.norm(u)
    half = np.asarray(angle, dtype=np.float64) / 2
    return matrix_from_quaternion(np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * u], -1))


def rotation_angle(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle in radians ``(...)`` of the rotation between ``a`` and ``b`` ``(..., 3, 3)``, accurate near 0."""
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    chord = np.linalg.norm(difference, axis=(-2, -1)) / np.sqrt(8.0)
    return 2 * np.arcsin(np.clip(chord, 0.0, 1.0))


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Rigid transforms ``(..., 4, 4)`` of rotations ``(..., 3, 3)`` and translations ``(..., 3)`` in metres."""
    r, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    batch = np.broadcast_shapes(r.shape[:-2], t.shape[:-1])
    result = np.zeros((*batch, 4, 4))
    result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = r, t, 1.0
    return result


def inverse(pose: ArrayLike) -> Array:
    """Inverse ``source_from_target`` of rigid transforms ``target_from_source`` ``(..., 4, 4)``."""
    p = np.asarray(pose, dtype=np.float64)
    r = np.swapaxes(p[..., :3, :3], -1, -2)
    return transform(r, -(r @ p[..., :3, 3:])[..., 0])


def apply(pose: ArrayLike, points: ArrayLike) -> Array:
    """Points ``(..., P, 3)`` of the source frame in the target frame of ``pose`` ``(..., 4, 4)``."""
    p, x = np.asarray(pose, dtype=np.float64), np.asarray(points, dtype=np.float64)
    return x @ np.swapaxes(p[..., :3, :3], -1, -2) + p[..., None, :3, 3]


def rotation_problem(rotations: Array) -> tuple[int, str] | None:
    """Index of the first of ``(N, 3, 3)`` that is no rotation and the end of a sentence about it, or None."""
    deviation = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max((-2, -1), initial=0.0)
    determinant = np.linalg.det(rotations)
    wrong = np.flatnonzero((deviation > ROTATION_TOLERANCE) | (determinant < 0))
    if not len(wrong):
        return None
    i = int(wrong[0])
    return i, (
        f"must be a rotation (R R^T = I within {ROTATION_TOLERANCE}, determinant +1), "
        f"got a deviation of {deviation[i]:.3g} and determinant {determinant[i]:.3g}"
    )
