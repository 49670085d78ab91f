"""Every rotation loss, value and gradient, against loops in double precision for every symmetry; Eqs. 5-8 by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from attentionvote.geometry.pose import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_quaternion,
    rotation_about,
)
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part
from attentionvote.training.pose_loss import SymmetricPose, quaternion_loss

Array = NDArray[np.float64]
ISOTROPIC = 0.1
KINDS = ("metric", "slerp", "minra", "nlerp")


def product(a: Array, b: Array) -> Array:
    """The quaternion product of Eq. (5), term by term."""
    (w, x, y, z), (v, i, j, k) = a, b
    return np.array([
        w * v - x * i - y * j - z * k, w * i + x * v + y * k - z * j,
        w * j - x * k + y * v + z * i, w * k + x * j - y * i + z * v,
    ])  # fmt: skip


def canonical(q: Array) -> Array:
    """The sign with the first component that is not 0 positive."""
    return q * next(math.copysign(1.0, c) for c in q if abs(c) > 1e-9)


def angle(cosine: float) -> float:
    return math.acos(min(1.0, max(-1.0, cosine)))


def by_hand(part: Part, kind: str, leaf: Array, true: Array) -> float:
    """The loss of one prediction: of a quaternion where the form is one of quaternions, else of a matrix."""
    group, axis = part.symmetry.rotations(), np.array(part.symmetry.axis)
    if kind == "metric":
        # Bregier et al. 2017, Eqs. 7 and 12: Lambda, or lambda times the axis; least over the group.
        root = part.covariance_root + ISOTROPIC * part.diameter * np.eye(3)
        if part.symmetry.is_revolution:
            squares = part.covariance_root @ part.covariance_root
            along = axis @ squares @ axis
            root = math.sqrt(along + (np.trace(squares) - along) / 2) * axis[:, None]
        least = min(((leaf @ root - true @ g @ root) ** 2).sum() for g in group)
        return math.sqrt(least) / (0.1 * part.diameter)
    if part.symmetry.is_revolution:  # Eq. 8
        return min(angle(float((leaf @ axis) @ (true @ g @ axis))) for g in group)
    values = []
    for g in group:
        dot = float(leaf @ canonical(quaternion_from_matrix(true @ g)))
        if kind == "nlerp":
            values.append(math.sqrt(max(0.0, 2 - 2 * dot)))
        else:  # Eqs. 6 and 7
            values.append(2 * angle(abs(dot) if kind == "minra" else dot))
    return min(values)


def of_quaternion(part: Part, kind: str) -> bool:
    return kind != "metric" and not part.symmetry.is_revolution


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_equal_a_loop_and_its_differences(
    symmetric_part: Part, make_rotations: Callable[[int, int], Array], kind: str
) -> None:
    pose, true = SymmetricPose.of(symmetric_part, ISOTROPIC), make_rotations(11, 6)
    q = random_quaternion(np.random.default_rng(12), (6,))
    q[1::2] *= -1  # of either sign
    turned = matrix_from_quaternion(q)
    quaternion, rotation, aims = (torch.from_numpy(a).float() for a in (q, turned, true))
    leaf = (quaternion if of_quaternion(symmetric_part, kind) else rotation).requires_grad_()
    loss = pose.rotation_loss(kind, quaternion, rotation, aims)
    (gradient,) = torch.autograd.grad(loss.sum(), leaf)
    for i, at in enumerate(q if of_quaternion(symmetric_part, kind) else turned):
        assert loss[i].item() == pytest.approx(by_hand(symmetric_part, kind, at, true[i]), rel=1e-4, abs=1e-5)
        # Along the rotations: off them Eqs. 6 to 8 (a scalar product) and the forms of half-chords differ.
        for axis in np.eye(3):
            ends = []
            for step in (1e-5, -1e-5):
                turn = rotation_about(axis, step)
                moved = at @ turn if at.ndim == 2 else product(at, np.r_[math.cos(step / 2), math.sin(step / 2) * axis])
                ends.append((moved, by_hand(symmetric_part, kind, moved, true[i])))
            (up, high), (down, low) = ends
            slope = float((gradient[i].double().numpy() * (up - down)).sum()) / 2e-5
            assert slope == pytest.approx((high - low) / 2e-5, rel=2e-3, abs=2e-3)


def test_equation_5_gives_the_increment_whose_angle_is_the_loss() -> None:
    rng = np.random.default_rng(3)
    for predicted, true in zip(random_quaternion(rng, (20,)), random_quaternion(rng, (20,)), strict=True):
        increment = product(predicted * [1, -1, -1, -1], true)
        np.testing.assert_allclose(product(predicted, increment), true, atol=1e-12)  # q^ = q (x) delta q
        phi = 2 * math.atan2(float(np.linalg.norm(increment[1:])), float(increment[0]))
        loss = quaternion_loss("slerp", torch.from_numpy(predicted), torch.from_numpy(true))
        assert loss.item() == pytest.approx(phi, abs=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 179.0, 181.0, 270.0, 360.0])
def test_equations_6_and_7_of_a_turn_by_a_known_angle(degrees: float) -> None:
    """A turn by phi about any axis is (cos phi/2, sin phi/2 u): Eq. 6 goes on to 2 pi, Eq. 7 turns back at pi."""
    phi, u = math.radians(degrees), np.array([1.0, 2.0, 2.0]) / 3
    turn = torch.from_numpy(np.r_[math.cos(phi / 2), math.sin(phi / 2) * u])
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    assert quaternion_loss("slerp", turn, identity).item() == pytest.approx(phi, abs=1e-5)
    assert quaternion_loss("minra", turn, identity).item() == pytest.approx(min(phi, 2 * math.pi - phi), abs=1e-5)
    assert quaternion_loss("nlerp", turn, identity).item() == pytest.approx(2 * math.sin(phi / 4), abs=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 40.0, 90.0, 140.0, 180.0])
@pytest.mark.parametrize("flip", [False, True])
def test_equation_8_of_a_known_tilt_whatever_the_turns_about_the_axis(
    make_box: Callable[..., Part], degrees: float, flip: bool
) -> None:
    pose = SymmetricPose.of(make_box(Symmetry("revolution", flip=flip)))
    about = [rotation_about([0, 0, 1], a) for a in (0.7, 2.9)]
    tilted = torch.from_numpy(about[0] @ rotation_about([1, 0, 0], math.radians(degrees)) @ about[1]).float()[None]
    expected = math.radians(min(degrees, 180 - degrees) if flip else degrees)
    for kind in KINDS[1:]:
        loss = pose.rotation_loss(kind, torch.zeros(1, 4), tilted, torch.eye(3)[None])
        assert loss.item() == pytest.approx(expected, abs=1e-3)


def test_the_metric_loss_needs_no_sign(make_box: Callable[..., Part], make_rotations: Callable) -> None:
    """Of the four only ``metric`` never looks at the quaternion, so no sign of a label can mislead it."""
    pose, rotation = SymmetricPose.of(make_box()), torch.from_numpy(make_rotations(0, 4)).float()
    q = torch.from_numpy(quaternion_from_matrix(make_rotations(0, 4))).float().requires_grad_()
    loss = pose.rotation_loss("metric", -q, rotation.requires_grad_(), torch.eye(3).expand(4, 3, 3))
    by_quaternion, by_rotation = torch.autograd.grad(loss.sum(), [q, rotation], allow_unused=True)
    assert by_quaternion is None
    assert by_rotation.isfinite().all()
