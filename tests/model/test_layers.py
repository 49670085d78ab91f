"""The building blocks against open-coded numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from attentionvote.model.layers import Residual, RowNorm, shared_mlp


@pytest.mark.parametrize("shape", [(12, 5), (3, 4, 5), (2, 3, 2, 5)], ids=str)
def test_row_norm_normalises_every_channel_over_all_rows(shape: tuple[int, ...]) -> None:
    x = torch.from_numpy(np.random.default_rng(0).normal(3, 2, shape).astype(np.float32))
    rows = x.reshape(-1, 5).double().numpy()
    norm = RowNorm(5)
    actual = norm(x)
    expected = (rows - rows.mean(0)) / np.sqrt(rows.var(0) + norm.eps)
    assert actual.shape == x.shape
    np.testing.assert_allclose(actual.detach().reshape(-1, 5), expected, atol=1e-5)


def test_row_norm_uses_running_statistics_in_evaluation() -> None:
    norm = RowNorm(2).eval()
    norm.running_mean.copy_(torch.tensor([1.0, 2.0]))
    norm.running_var.copy_(torch.tensor([4.0, 9.0]))
    expected = torch.tensor([[1.0, 1.0]])
    torch.testing.assert_close(norm(torch.tensor([[3.0, 5.0]])), expected, rtol=1e-5, atol=1e-5)


def test_shared_mlp_is_linear_norm_relu_and_a_plain_last_layer() -> None:
    kinds = [type(m) for m in shared_mlp(6, [8, 4], 3)]
    assert kinds == [nn.Linear, RowNorm, nn.ReLU, nn.Linear, RowNorm, nn.ReLU, nn.Linear]
    assert [type(m) for m in shared_mlp(6, [8])] == [nn.Linear, RowNorm, nn.ReLU]
    x = torch.randn(10, 6, generator=torch.Generator().manual_seed(0))
    mlp = shared_mlp(6, [8], 3).eval()
    w, b = (p.detach().numpy() for p in mlp[3].parameters())
    hidden = np.maximum(x.numpy() @ mlp[0].weight.detach().numpy().T / np.sqrt(1 + mlp[1].eps), 0)
    np.testing.assert_allclose(mlp(x).detach(), hidden @ w.T + b, atol=1e-5)


def test_residual_adds_to_its_input_and_leaves_it_alone() -> None:
    block = Residual(8).eval()
    x = torch.randn(4, 5, 8, generator=torch.Generator().manual_seed(0))
    before = x.clone()
    torch.testing.assert_close(block(x), torch.relu(x + block.mlp(x)))
    torch.testing.assert_close(x, before, rtol=0, atol=0)
    nn.init.zeros_(block.mlp[-1].weight)
    torch.testing.assert_close(block(x), torch.relu(x))
