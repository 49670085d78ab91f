"""Features of a finer level from the three nearest centres of a coarser one, its own features beside them."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from attentionvote.geometry import native
from attentionvote.model.kernels import kernels
from attentionvote.model.row_threads import in_threads

_FILE = "network_ops.c"


def interpolate_reference(
    coarse: Float[Tensor, "batch coarse channels"],
    fine: Float[Tensor, "batch fine fine_channels"],
    nearest: Int[Tensor, "batch fine 3"],
    weights: Float[Tensor, "batch fine 3"],
) -> Float[Tensor, "batch fine both"]:
    """Weighted sum of the features of each fine point's three nearest coarse ones (PointNet++), then its own features.

    Args:
        coarse: features of the coarser level.
        fine: own features of the finer level.
        nearest: rows of ``coarse``, within the sample.
        weights: of the three, sum one.
    """
    batch, rows, channels = coarse.shape
    # [b, fine, 3] indices within a sample -> rows of [b * coarse, c]
    index = nearest + torch.arange(batch, device=coarse.device)[:, None, None] * rows
    # One table of rows: the gradient of a lookup in it costs a third of that of an index by sample and row.
    # [b, coarse, c] -> [b * coarse, c] -> [b, fine, 3, c]
    gathered = torch.nn.functional.embedding(index, coarse.reshape(-1, channels))
    # [b, fine, 3, c] * [b, fine, 3, 1] -> [b, fine, c]
    return torch.cat([(gathered * weights[..., None]).sum(-2), fine], dim=-1)


def interpolate(
    coarse: Float[Tensor, "batch coarse channels"],
    fine: Float[Tensor, "batch fine fine_channels"],
    nearest: Int[Tensor, "batch fine 3"],
    weights: Float[Tensor, "batch fine 3"],
) -> Float[Tensor, "batch fine both"]:
    """``interpolate_reference`` by the fastest means at hand; ``weights`` get no gradient."""
    if kernels(_FILE, coarse, fine, weights) is None:
        return interpolate_reference(coarse, fine, nearest, weights)
    result: Tensor = _Interpolate.apply(coarse, fine, nearest.long(), weights.detach())
    return result


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coarse: Tensor, fine: Tensor, nearest: Tensor, weights: Tensor) -> Tensor:
        coarse, fine, nearest, weights = (t.contiguous() for t in (coarse, fine, nearest, weights))
        ctx.sizes = coarse.shape[1], fine.shape[1], coarse.shape[2], fine.shape[2]
        out = coarse.new_empty(*fine.shape[:2], coarse.shape[2] + fine.shape[2])
        inputs, library = [t.numpy() for t in (coarse, fine, nearest, weights)], kernels(_FILE)
        assert library is not None

        def work(_: int, *samples: int) -> None:
            native.call(library.interpolate, *inputs, *map(native.long, samples), *ctx.sizes, out.numpy())

        in_threads(len(coarse), work, least=1)
        ctx.save_for_backward(nearest, weights)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        nearest, weights = ctx.saved_tensors
        batch, (below, rows, width, fine_width) = len(weights), ctx.sizes
        grad_coarse, grad_fine = weights.new_empty(batch, below, width), weights.new_empty(batch, rows, fine_width)
        inputs = [t.numpy() for t in (gradients[0].contiguous(), nearest, weights)]
        out, library = [t.numpy() for t in (grad_coarse, grad_fine)], kernels(_FILE)
        assert library is not None

        def work(_: int, *samples: int) -> None:
            native.call(library.interpolate_backward, *inputs, *map(native.long, samples), *ctx.sizes, *out)

        in_threads(batch, work, least=1)
        return grad_coarse, grad_fine, None, None
