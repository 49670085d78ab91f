"""Features between centres: the C functions against plain torch, and that against a loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from attentionvote.model.interpolation import interpolate, interpolate_reference

pytestmark = pytest.mark.usefixtures("kernels")


def arguments(batch: int, below: int, rows: int, width: int, own: int, seed: int = 0) -> tuple[Tensor, ...]:
    rng = np.random.default_rng(seed)
    coarse, fine = (rng.normal(size=s).astype(np.float32) for s in ((batch, below, width), (batch, rows, own)))
    weights = rng.dirichlet([1, 1, 1], (batch, rows)).astype(np.float32)
    nearest = rng.integers(0, below, (batch, rows, 3))
    return tuple(map(torch.from_numpy, (coarse, fine, nearest, weights)))


def run(function: object, coarse: Tensor, fine: Tensor, *rest: Tensor) -> list[Tensor]:
    """Value, and gradients of a random linear form of it."""
    leaves = [coarse.clone().requires_grad_(), fine.clone().requires_grad_()]
    value = function(*leaves, *rest)  # type: ignore[operator]
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=value.shape).astype(np.float32))
    return [value.detach(), *torch.autograd.grad((value * direction).sum(), leaves)]


@pytest.mark.parametrize("sizes", [(1, 1, 1, 1, 1), (2, 5, 7, 3, 4), (5, 8, 16, 32, 16), (3, 4, 6, 17, 0)], ids=str)
def test_kernel_equals_reference(sizes: tuple) -> None:
    inputs = arguments(*sizes)
    for a, b in zip(run(interpolate, *inputs), run(interpolate_reference, *inputs), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_reference_equals_a_loop() -> None:
    coarse, fine, nearest, weights = arguments(2, 5, 7, 3, 4)
    actual = interpolate_reference(coarse, fine, nearest, weights)
    for sample in range(2):
        for t in range(7):
            mean = sum(weights[sample, t, k] * coarse[sample, nearest[sample, t, k]] for k in range(3))
            torch.testing.assert_close(actual[sample, t], torch.cat([mean, fine[sample, t]]))


def test_gradients_are_those_of_finite_differences() -> None:
    coarse, fine, nearest, weights = (t.double() if t.is_floating_point() else t for t in arguments(2, 3, 4, 2, 1))
    inputs = coarse.requires_grad_(), fine.requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: interpolate(a, b, nearest, weights), inputs)


@pytest.mark.parametrize("change", ["columns", "int32", "half"])
def test_any_layout_and_type_gives_the_same(change: str) -> None:
    coarse, fine, nearest, weights = arguments(2, 5, 7, 8, 4)
    expected = run(interpolate, coarse, fine, nearest, weights)
    if change == "columns":
        coarse, fine, weights = (t.mT.contiguous().mT for t in (coarse, fine, weights))
    elif change == "int32":
        nearest = nearest.int()
    else:
        coarse, fine = coarse.bfloat16(), fine.bfloat16()
    for a, b in zip(run(interpolate, coarse, fine, nearest, weights), expected, strict=True):
        torch.testing.assert_close(a.float(), b, rtol=0.05, atol=0.1 if change == "half" else 1e-6)
