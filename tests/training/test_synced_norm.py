"""Batch statistics of several processes are those of the whole batch, in value, gradient and memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from attentionvote.model.layers import RowNorm, shared_mlp
from attentionvote.training.synced_norm import RowNormSync, SyncedRowNorm

InProcesses = Callable[[int, Callable[..., Any]], list[Any]]


def norm() -> RowNorm:
    layer = RowNorm(5).double()
    with torch.no_grad():
        layer.weight.copy_(torch.linspace(0.5, 2.0, 5))
        layer.bias.copy_(torch.linspace(-1.0, 1.0, 5))
    return layer


def steps(layer: nn.Module, batches: list[torch.Tensor], aims: list[torch.Tensor]) -> dict[str, Any]:
    """Two training steps without an update: values, gradients of input and weights, running statistics."""
    out: dict[str, Any] = {"y": [], "dx": []}
    for rows, aim in zip(batches, aims, strict=True):
        x = rows.clone().requires_grad_()
        y = layer(x)
        (y * aim).sum().backward()
        assert x.grad is not None
        out["y"].append(y.detach())
        out["dx"].append(x.grad)
    out["weight"], out["bias"] = layer.weight.grad, layer.bias.grad  # type: ignore[union-attr]
    out["state"] = {name: value.clone() for name, value in layer.state_dict().items()}
    return out


@pytest.mark.parametrize("cuts", [(0, 4, 4, 10), (0, 9, 10, 10), (0, 3, 6, 10)])  # a share may be empty
def test_shares_make_the_whole(in_processes: InProcesses, cuts: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(1)
    # Far from zero, where a mean of squares would cancel.
    batches = [torch.randn(10, 5, generator=generator, dtype=torch.float64) * (k + 1) + 1000 for k in range(2)]
    aims = [torch.randn(10, 5, generator=generator, dtype=torch.float64) for _ in range(2)]

    def share(rank: int) -> dict[str, Any]:
        layer = RowNormSync().apply(norm())
        assert type(layer) is SyncedRowNorm
        mine = slice(cuts[rank], cuts[rank + 1])
        return steps(layer, [b[mine] for b in batches], [a[mine] for a in aims])

    whole, shares = steps(norm(), batches, aims), in_processes(3, share)
    for k in range(2):
        for name in ("y", "dx"):
            torch.testing.assert_close(torch.cat([s[name][k] for s in shares]), whole[name][k], rtol=1e-9, atol=1e-9)
    for name in ("weight", "bias"):  # what Lightning's strategy averages, here added up
        torch.testing.assert_close(sum(s[name] for s in shares), whole[name], rtol=1e-9, atol=1e-9)
    for s in shares:
        assert all(torch.equal(s["state"][name], value) for name, value in shares[0]["state"].items())
        torch.testing.assert_close(dict(s["state"]), dict(whole["state"]), rtol=1e-9, atol=1e-9)


def test_lightning_s_hook_changes_the_class_and_nothing_else() -> None:
    network = shared_mlp(3, [4, 4], 2)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    sync = RowNormSync()
    sync.apply(network)
    assert sum(type(m) is SyncedRowNorm for m in network.modules()) == 2
    assert network.state_dict().keys() == before.keys()
    x = torch.randn(2, 3, 3)
    evaluated = network.eval()(x)
    sync.revert(network)
    assert sum(type(m) is RowNorm for m in network.modules()) == 2
    assert torch.equal(network(x), evaluated)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_half_precision_keeps_its_type_and_its_statistics() -> None:
    layer = SyncedRowNorm(4)
    x = (torch.randn(64, 4) * 3 + 20).to(torch.bfloat16).requires_grad_()
    y = layer(x)
    assert y.dtype == torch.bfloat16
    assert y.float().mean().abs() < 0.02
    y.sum().backward()
    assert x.grad is not None
    assert x.grad.dtype == torch.bfloat16
    assert layer.running_mean is not None
    assert layer.running_mean.dtype == torch.float32
