"""Batch statistics over the batch of all processes, so that several train the network that one would have trained.

``torch.nn.SyncBatchNorm`` refuses tensors on a CPU and batches of no rows; a process none of whose scenes has a
proposal has no rows.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch.plugins import LayerSync
from torch import Tensor, nn

from attentionvote.model.layers import RowNorm
from attentionvote.training.processes import everyones, summed


class SyncedRowNorm(RowNorm):
    """``RowNorm`` whose training statistics are those of the rows of all processes; they hold the same bits in each."""

    def forward(self, x: Float[Tensor, "*rows channels"]) -> Float[Tensor, "*rows channels"]:
        """Normalise each channel over the rows of all processes (running statistics in evaluation)."""
        if not self.training:
            return super().forward(x)
        # [..., c] -> [r, c]
        rows = x.reshape(-1, x.shape[-1])
        count, mean, variance = _statistics(rows)
        self._remember(count, mean, variance)
        scale = (variance + self.eps).rsqrt()
        out: Tensor = _Normalize.apply(rows, self.weight, self.bias, mean, scale, count)
        # [r, c] -> [..., c]
        return out.view(x.shape)

    @torch.no_grad()
    def _remember(self, count: Tensor, mean: Tensor, variance: Tensor) -> None:
        assert self.momentum is not None
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        unbiased = variance * (count / (count - 1.0).clamp(min=1.0))
        for running, value in ((self.running_mean, mean), (self.running_var, unbiased)):
            running.copy_((1 - self.momentum) * running + self.momentum * value)
        self.num_batches_tracked.add_(1)


class RowNormSync(LayerSync):
    """Lightning's hook: every ``RowNorm`` of the module synchronises while it trains."""

    def apply(self, model: nn.Module) -> nn.Module:
        """Weights, buffers and their names stay what they are."""
        return _reclass(model, RowNorm, SyncedRowNorm)

    def revert(self, model: nn.Module) -> nn.Module:
        """The plain layers again."""
        return _reclass(model, SyncedRowNorm, RowNorm)


def _reclass(model: nn.Module, old: type[nn.Module], new: type[nn.Module]) -> nn.Module:
    for module in model.modules():
        if type(module) is old:
            module.__class__ = new
    return model


def _wide(rows: Tensor) -> Tensor:
    return rows.float() if rows.dtype in (torch.float16, torch.bfloat16) else rows


@torch.no_grad()
def _statistics(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Number, mean and biased variance of the rows of all processes: each tells its own (Chan et al. 1979)."""
    wide = _wide(rows)
    local_mean = wide.mean(0) if len(wide) else wide.new_zeros(wide.shape[1])
    local_sum = (wide - local_mean).square().sum(0)
    size = local_mean.new_full((1,), float(len(wide)), dtype=torch.float64)
    gathered = everyones(torch.cat([size, local_mean.double(), local_sum.double()]))
    # [processes, 1 + 2 c] -> [processes, 1] and two of [processes, c]
    counts, means, sums = gathered[:, :1], *gathered[:, 1:].chunk(2, dim=1)
    count = counts.sum().clamp(min=1.0)
    mean = (counts * means).sum(0) / count
    variance = (sums + counts * (means - mean).square()).sum(0) / count
    return count.to(wide.dtype), mean.to(wide.dtype), variance.to(wide.dtype)  # no wait for a GPU


class _Normalize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, mean: Tensor, scale: Tensor, count: Tensor
    ) -> Tensor:
        ctx.save_for_backward(rows, weight, mean, scale, count)
        return ((_wide(rows) - mean) * (scale * weight) + bias).to(rows.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, mean, scale, count = ctx.saved_tensors
        gradient = _wide(gradients[0])
        normed = (_wide(rows) - mean) * scale
        local_sums = torch.stack([gradient.sum(0), (gradient * normed).sum(0)])
        # A row moves the statistics of all rows, those of other processes included.
        along, across = summed(local_sums) / count
        moved = (gradient - along - normed * across) * (scale * weight)
        return moved.to(rows.dtype), local_sums[1], local_sums[0], None, None, None
