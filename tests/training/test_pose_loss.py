"""Rotation losses and the pose distance against numpy, for every symmetry, and where their formulas break."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from attentionvote.evaluation import PoseMetric
from attentionvote.geometry.pose import (
    canonical_quaternion,
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_quaternion,
    rotation_about,
    rotation_angle,
    transform,
)
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part
from attentionvote.training.pose_loss import SymmetricPose, angle_between, equivalent_quaternions, quaternion_loss

KINDS = ("metric", "slerp", "minra", "nlerp")


def tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values)).float()


def symmetric_rotations(part: Part, rotations: np.ndarray, seed: int) -> np.ndarray:
    """Each rotation replaced by an equivalent one."""
    rng = np.random.default_rng(seed)
    group = part.symmetry.rotations()
    turned = rotations @ group[rng.integers(0, len(group), len(rotations))]
    if part.symmetry.is_revolution:
        turned = turned @ rotation_about(part.symmetry.axis, rng.uniform(0, 2 * np.pi, len(rotations)))
    return turned


@pytest.mark.parametrize("seed", range(3))
def test_distance_is_the_evaluations(symmetric_part: Part, make_rotations: Callable, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_rotations(seed, 30), make_rotations(seed + 100, 30)
    second[:10] = symmetric_rotations(symmetric_part, first[:10], seed) @ rotation_about([1, 1, 0], 0.02)
    centers = rng.normal(0, 0.02, (2, 30, 3))
    expected = np.diagonal(
        PoseMetric.of(symmetric_part).distances(transform(first, centers[0]), transform(second, centers[1]))
    )
    pose = SymmetricPose.of(symmetric_part)
    actual = pose.distance(tensor(centers[0]), tensor(first), tensor(centers[1]), tensor(second))
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("isotropic", [0.0, 0.1])
def test_equivalent_rotations_have_no_loss(
    symmetric_part: Part, make_rotations: Callable, kind: str, isotropic: float
) -> None:
    true = make_rotations(3, 40)
    predicted = symmetric_rotations(symmetric_part, true, 4)
    pose = SymmetricPose.of(symmetric_part, isotropic)
    loss = pose.rotation_loss(kind, tensor(quaternion_from_matrix(predicted)), tensor(predicted), tensor(true))
    assert loss.max() < 1e-4  # float32, and the 1e-6 that keep the gradients bounded
    if kind == "metric":
        off = tensor(predicted @ rotation_about([1, 0.5, 0.3], 0.1))
        assert pose.rotation_loss(kind, torch.zeros(40, 4), off, tensor(true)).min() > 1e-3


@settings(max_examples=40)
@given(st.integers(0, 2**31))
def test_quaternion_losses_are_equations_5_to_7(seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted = rng.normal(size=(6, 4))
    predicted /= np.linalg.norm(predicted, axis=1, keepdims=True)  # of either sign
    true = random_quaternion(rng, (6,))
    dot = (predicted * true).sum(1)
    slerp, minra, nlerp = (
        quaternion_loss(k, torch.from_numpy(predicted), torch.from_numpy(true)).numpy() for k in KINDS[1:]
    )
    np.testing.assert_allclose(slerp, 2 * np.arccos(dot), atol=1e-5)
    np.testing.assert_allclose(minra, 2 * np.arccos(np.abs(dot)), atol=1e-5)
    np.testing.assert_allclose(nlerp, np.linalg.norm(predicted - true, axis=1), atol=1e-6)
    assert ((slerp >= 0) & (slerp <= 2 * np.pi + 1e-6)).all()
    # Eq. (5): the angle of the increment between the two rotations.
    between = rotation_angle(matrix_from_quaternion(predicted), matrix_from_quaternion(true))
    np.testing.assert_allclose(minra, between, atol=1e-5)
    np.testing.assert_allclose(np.minimum(slerp, 2 * np.pi - slerp), between, atol=1e-5)


def test_slerp_depends_on_the_sign_and_minra_does_not(make_rotations: Callable) -> None:
    pose, true = SymmetricPose(0.1, torch.eye(3)[None], torch.eye(3), None), make_rotations(0, 5)
    q = tensor(canonical_quaternion(quaternion_from_matrix(true)))
    losses = {k: pose.rotation_loss(k, -q, tensor(true), tensor(true)) for k in KINDS[1:]}
    torch.testing.assert_close(losses["slerp"], torch.full((5,), 2 * torch.pi), rtol=0, atol=1e-5)
    torch.testing.assert_close(losses["minra"], torch.zeros(5), rtol=0, atol=1e-5)
    torch.testing.assert_close(losses["nlerp"], torch.full((5,), 2.0), rtol=0, atol=1e-5)


@settings(max_examples=30)
@given(st.integers(0, 2**31))
def test_revolution_is_the_angle_between_the_axes_of_equation_8(make_box: Callable, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, p = random_quaternion(rng, (6,)), random_quaternion(rng, (6,))

    def z_axis(quaternion: np.ndarray) -> np.ndarray:
        w, x, y, z = quaternion.T
        return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), z * z + w * w - y * y - x * x], axis=1)

    cosine = np.clip((z_axis(q) * z_axis(p)).sum(1), -1, 1)
    given_rotations = tensor(q), tensor(matrix_from_quaternion(q)), tensor(matrix_from_quaternion(p))
    for flip, expected in ((False, np.arccos(cosine)), (True, np.arccos(np.abs(cosine)))):
        pose = SymmetricPose.of(make_box(Symmetry("revolution", flip=flip)))
        for kind in KINDS[1:]:
            np.testing.assert_allclose(pose.rotation_loss(kind, *given_rotations), expected, atol=1e-3)


@pytest.mark.parametrize("kind", ["slerp", "minra"])
def test_cyclic_symmetry_takes_the_least_over_the_equivalent_poses(
    make_box: Callable, make_rotations: Callable, kind: str
) -> None:
    part = make_box(Symmetry("cyclic", (1, 2, 2), order=3))
    predicted, true = make_rotations(1, 20), make_rotations(2, 20)
    q = quaternion_from_matrix(predicted)
    every = []
    for element in part.symmetry.rotations():
        dot = (q * canonical_quaternion(quaternion_from_matrix(true @ element))).sum(1)
        every.append(2 * np.arccos(np.clip(np.abs(dot) if kind == "minra" else dot, -1, 1)))
    actual = SymmetricPose.of(part).rotation_loss(kind, tensor(q), tensor(predicted), tensor(true))
    np.testing.assert_allclose(actual, np.min(every, axis=0), atol=1e-4)


def test_metric_loss_is_one_at_the_limit_of_the_evaluation(make_box: Callable) -> None:
    part = make_box()
    pose = SymmetricPose.of(part)
    turn = rotation_about([0, 0, 1], 0.4)
    reference = PoseMetric.of(part).distances(transform(turn, np.zeros(3))[None], np.eye(4)[None])[0, 0]
    loss = pose.rotation_loss("metric", torch.zeros(1, 4), tensor(turn[None]), torch.eye(3)[None])
    np.testing.assert_allclose(loss, reference / (0.1 * part.diameter), rtol=1e-4)


SINGULAR = {
    "equal": np.eye(3),
    "half turn about x": rotation_about([1, 0, 0], np.pi),
    "half turn about z": rotation_about([0, 0, 1], np.pi),
    "half turn about a diagonal": rotation_about([1, 2, 2], np.pi),
    "quarter turn": rotation_about([1, 0, 0], np.pi / 2),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", SINGULAR)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gradients_are_finite_where_formulas_break(symmetric_part: Part, kind: str, case: str, sign: float) -> None:
    turn = SINGULAR[case]
    quaternion = (sign * tensor(quaternion_from_matrix(turn)[None])).requires_grad_()
    rotation = tensor(turn[None]).requires_grad_()
    loss = SymmetricPose.of(symmetric_part).rotation_loss(kind, quaternion, rotation, torch.eye(3)[None])
    leaf = quaternion if kind != "metric" and not symmetric_part.symmetry.is_revolution else rotation
    (gradient,) = torch.autograd.grad(loss.sum(), leaf)
    assert loss.isfinite().all()
    assert gradient.isfinite().all()
    assert gradient.abs().max() < 100


@pytest.mark.parametrize("kind", KINDS[1:])
def test_gradients_equal_finite_differences(kind: str) -> None:
    rng = np.random.default_rng(0)
    predicted = torch.from_numpy(random_quaternion(rng, (4,))).requires_grad_()
    true = torch.from_numpy(random_quaternion(rng, (4,)))
    assert torch.autograd.gradcheck(lambda q: quaternion_loss(kind, q, true), predicted)


def test_angle_between_opposite_and_equal_axes() -> None:
    z = torch.tensor([[0.0, 0, 1]])
    for other, angle in ((z, 0.0), (-z, np.pi), (torch.tensor([[1.0, 0, 0]]), np.pi / 2)):
        a = z.clone().requires_grad_()
        value = angle_between(a, other)
        (gradient,) = torch.autograd.grad(value.sum(), a)
        np.testing.assert_allclose(value.detach(), angle, atol=1e-5)
        assert gradient.isfinite().all()


def test_an_unknown_kind_is_refused(make_box: Callable) -> None:
    one = torch.eye(3)[None]
    with pytest.raises(ValueError, match="rotation loss must be one of metric, slerp, minra, nlerp, got 'euler'"):
        SymmetricPose.of(make_box()).rotation_loss("euler", torch.zeros(1, 4), one, one)


def test_everything_follows_device_and_precision_of_the_predictions(make_box: Callable) -> None:
    pose = SymmetricPose.of(make_box(Symmetry("revolution", flip=True)))
    for dtype in (torch.float32, torch.float64):
        own = pose.like(torch.zeros((), device="meta", dtype=dtype))
        assert own.axis is not None
        assert {(t.device.type, t.dtype) for t in (own.group, own.representation, own.axis)} == {("meta", dtype)}


def test_losses_are_computed_where_the_poses_are(symmetric_part: Part) -> None:
    # The meta device refuses tensors of another device, as a GPU does.
    pose, rotation = SymmetricPose.of(symmetric_part), torch.zeros(4, 3, 3, device="meta")
    center = torch.zeros(4, 3, device="meta")
    assert pose.distance(center, rotation, center, rotation).device.type == "meta"
    kind = "slerp" if symmetric_part.symmetry.is_revolution else "metric"
    assert pose.rotation_loss(kind, center.new_zeros(4, 4), rotation, rotation).device.type == "meta"


def test_labels_of_a_gpu_are_those_of_a_cpu(symmetric_part: Part, make_rotations: Callable) -> None:
    pose = SymmetricPose.of(symmetric_part)
    halves = np.stack([rotation_about(axis, np.pi) for axis in np.vstack([np.eye(3), [[0, 1, -1]], [[1, -1, 1]]])])
    true = torch.from_numpy(np.concatenate([make_rotations(5, 200), halves, np.eye(3)[None]]))
    for rotations in (true, true.float()):
        labels = equivalent_quaternions(rotations, pose.group)
        assert labels.dtype == rotations.dtype
        on_cpu = pose._equivalents(rotations)
        same = (labels - on_cpu).abs().amax(-1) < 1e-7 if rotations is true else (labels - on_cpu).abs().amax(-1) < 1e-6
        # q and -q of a half turn, whose first component is rounding: either is a label, and few are.
        assert same[:200].all()
        assert ((labels + on_cpu).abs().amax(-1) < 1e-6)[~same].all()
        assert (~same).sum() <= 3


def test_quaternion_losses_run_on_a_gpu(make_box: Callable) -> None:
    pose, rotation = SymmetricPose.of(make_box()), torch.zeros(4, 3, 3, device="meta")
    assert pose.rotation_loss("slerp", torch.zeros(4, 4, device="meta"), rotation, rotation).device.type == "meta"
