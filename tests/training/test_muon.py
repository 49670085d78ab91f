"""Muon: its iteration against singular values, its steps against torch's own Muon and AdamW."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from attentionvote.training.muon import Muon, orthogonalized


def random_tensor(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def taken_steps(optimizer: torch.optim.Optimizer, weights: Sequence[Tensor], steps: int, first: int = 0) -> None:
    """Steps along gradients that depend on the step's number and the weight's shape alone."""
    for step in range(first, first + steps):
        for weight in weights:
            weight.grad = random_tensor(*weight.shape, seed=step)
        optimizer.step()


@given(rows=st.integers(1, 40), columns=st.integers(1, 40), scale=st.floats(1e-6, 1e6), seed=st.integers(0, 99))
def test_the_singular_values_are_nearly_one(rows: int, columns: int, scale: float, seed: int) -> None:
    # A well-conditioned matrix: five iterations bring singular values from .05 of the norm on to about one.
    left, _, right = torch.linalg.svd(random_tensor(rows, columns, seed=seed), full_matrices=False)
    values = torch.linspace(1.0, 0.5, min(rows, columns))
    matrix = scale * (left * values) @ right
    result = orthogonalized(matrix[None])[0]
    assert result.shape == matrix.shape
    singular = torch.linalg.svdvals(result)
    assert 0.6 < float(singular.min()) <= float(singular.max()) < 1.25
    # The same directions: only the singular values were changed.
    turned = left.mT @ result @ right.mT
    assert float((turned - torch.diag(torch.diagonal(turned))).abs().max()) < 1e-3


def test_a_stack_is_its_matrices_one_by_one_and_zero_stays_zero() -> None:
    stack = random_tensor(3, 24, 17)
    stack[1] = 0.0
    together = orthogonalized(stack)
    for matrix, result in zip(stack, together, strict=True):
        torch.testing.assert_close(orthogonalized(matrix[None])[0], result, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(orthogonalized(matrix.T[None])[0].T, result, rtol=1e-4, atol=1e-5)
    assert not together[1].any()


@pytest.mark.parametrize("shape", [(32, 32), (48, 16), (16, 40)])
def test_matrices_go_as_with_torchs_muon(shape: tuple[int, int]) -> None:
    ours, theirs = (torch.nn.Parameter(random_tensor(*shape, seed=7)) for _ in range(2))
    taken_steps(Muon([ours], lr=0.02, weight_decay=0.1), [ours], 4)
    reference = torch.optim.Muon([theirs], lr=0.02, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    taken_steps(reference, [theirs], 4)
    moved = (theirs.detach() - random_tensor(*shape, seed=7)).norm()
    # torch iterates in bfloat16, which has three digits.
    assert float((ours.detach() - theirs.detach()).norm() / moved) < 0.03
    assert float(moved) > 0.02 * 0.2 * max(shape) ** 0.5


def test_other_weights_go_as_with_adamw() -> None:
    shapes = [(32,), (4, 32), (32, 15)]
    ours, theirs = ([torch.nn.Parameter(random_tensor(*s, seed=3)) for s in shapes] for _ in range(2))
    taken_steps(Muon(ours, lr=0.01, weight_decay=0.1, betas=(0.9, 0.95)), ours, 5)
    for weight in theirs:
        decay = 0.1 if weight.ndim > 1 else 0.0
        taken_steps(torch.optim.AdamW([weight], lr=0.003, weight_decay=decay, betas=(0.9, 0.95)), [weight], 5)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def test_it_goes_on_from_its_state() -> None:
    whole, continued = ([torch.nn.Parameter(random_tensor(*s)) for s in ((20, 20), (8,))] for _ in range(2))
    taken_steps(Muon(whole), whole, 6)
    first = Muon(continued)
    taken_steps(first, continued, 3)
    second = Muon(continued)
    second.load_state_dict(first.state_dict())
    taken_steps(second, continued, 3, first=3)
    for a, b in zip(whole, continued, strict=True):
        assert torch.equal(a, b)


def test_weights_without_a_gradient_stay() -> None:
    weights = [torch.nn.Parameter(random_tensor(20, 20)), torch.nn.Parameter(random_tensor(20, 20, seed=1))]
    before = weights[1].detach().clone()
    optimizer = Muon(weights, weight_decay=0.5)
    weights[0].grad = random_tensor(20, 20, seed=2)
    optimizer.step()
    assert torch.equal(weights[1], before)
    assert not torch.equal(weights[0], random_tensor(20, 20))


def test_a_closure_computes_the_gradients() -> None:
    weight = torch.nn.Parameter(random_tensor(16, 16))
    optimizer = Muon([weight], lr=0.2)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = weight.square().sum()
        loss.backward()
        return loss

    losses = [optimizer.step(closure).item() for _ in range(20)]
    assert losses[-1] < 0.5 * losses[0]
