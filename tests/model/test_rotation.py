"""Rotations in torch against scipy, and at the places where formulas break."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from attentionvote.model.rotation import (
    matrix_from_quaternion,
    matrix_from_six,
    quaternion_from_matrix,
    unit_quaternion,
)

SEEDS = st.integers(0, 2**31)
HALF_TURNS = torch.eye(4)[1:]  # 180 degrees about x, y, z


def quaternions(seed: int, count: int = 8) -> Tensor:
    """Quaternions (w, x, y, z) of any length and sign."""
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(count, 4)))


@given(SEEDS)
def test_matrix_of_a_quaternion_is_scipys(seed: int) -> None:
    q = quaternions(seed)
    expected = Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()
    # The tiny constant under the root shortens a quaternion of length 0.01 by 5e-9.
    np.testing.assert_allclose(matrix_from_quaternion(q), expected, atol=1e-7)


@given(SEEDS)
def test_quaternion_of_a_matrix_is_scipys(seed: int) -> None:
    matrix = Rotation.random(8, random_state=seed).as_matrix()
    actual = quaternion_from_matrix(torch.from_numpy(matrix))
    assert (actual[:, 0] >= 0).all()
    expected = Rotation.from_matrix(matrix).as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(actual, expected, atol=1e-9)


@pytest.mark.parametrize("turn", [torch.eye(4)[0], *HALF_TURNS, torch.tensor([0, 0.6, 0.0, 0.8])], ids=str)
def test_quaternion_of_a_half_turn_survives_the_way_there_and_back(turn: Tensor) -> None:
    matrix = matrix_from_quaternion(turn.double()).requires_grad_()
    back = quaternion_from_matrix(matrix)
    assert min((back - turn).abs().max(), (back + turn).abs().max()) < 1e-7  # 0.6 and 0.8 were float32
    (gradient,) = torch.autograd.grad(back.sum(), matrix)
    assert gradient.isfinite().all()


@pytest.mark.parametrize("seed", range(3))
def test_gradients_equal_finite_differences(seed: int) -> None:
    q = quaternions(seed, 2).requires_grad_()
    assert torch.autograd.gradcheck(matrix_from_quaternion, q)
    assert torch.autograd.gradcheck(matrix_from_six, torch.cat([q, q.flip(0)], -1)[:, :6].detach().requires_grad_())


def test_the_zero_quaternion_is_the_identity_with_a_finite_gradient() -> None:
    q = torch.zeros(1, 4, requires_grad=True)
    matrix = matrix_from_quaternion(q)
    torch.testing.assert_close(matrix[0], torch.eye(3))
    (gradient,) = torch.autograd.grad(unit_quaternion(q).sum() + matrix.sum(), q)
    assert gradient.isfinite().all()


@given(SEEDS, st.floats(0.3, 3), st.floats(0.3, 3), st.floats(-1, 1))
def test_matrix_of_six_numbers_ignores_lengths_and_the_second_vectors_share_of_the_first(
    seed: int, first: float, second: float, share: float
) -> None:
    rotation = Rotation.random(random_state=seed).as_matrix()
    x, y = rotation[:, 0], rotation[:, 1]
    six = torch.from_numpy(np.concatenate([first * x, second * y + share * x]))
    # The constant under the root, 1e-6, shortens x by 6e-6 at length 0.3, and y then keeps some of it.
    np.testing.assert_allclose(matrix_from_six(six), rotation, atol=1e-4)


@pytest.mark.parametrize(
    "six",
    [[0.0] * 6, [1, 0, 0, 2, 0, 0], [1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0]],
    ids=["zero", "parallel", "no y", "no x"],
)
def test_six_numbers_that_span_no_plane_give_finite_values_and_gradients(six: list[float]) -> None:
    value = torch.tensor([six], dtype=torch.float32, requires_grad=True)
    matrix = matrix_from_six(value)
    (gradient,) = torch.autograd.grad(matrix.sum(), value)
    assert matrix.isfinite().all()
    assert gradient.isfinite().all()
