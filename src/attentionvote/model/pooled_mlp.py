"""Shared MLP over the neighbours of a centre, then the maximum: the arithmetic heart of a set abstraction.

Two implementations of one function: ``pooled_mlp_reference`` in plain torch (any device, exportable, the oracle of
the tests) and a C kernel for training on a CPU, which keeps a centre's activations in the cache, recomputes them in
the backward pass, and uses that the maximum passes its gradient to one neighbour a channel.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.geometry import native
from attentionvote.model.kernels import kernels
from attentionvote.model.row_threads import LEAST_ROWS, in_threads, thread_count

MOST_NUMBERS = 2**27  # of one layer's activations outside training: 512 MB
MOST_NEIGHBORS = 256  # the winner of a maximum is kept in a byte
_FILE = "pooled_mlp.c"
MOST_LAYERS = 9  # as many as the kernel has pointers for


def pooled_mlp_reference(
    geometry: Float[Tensor, "centers neighbors channels"],
    projected: Float[Tensor, "sources width"] | None,
    index: Int[Tensor, "centers neighbors"],
    weights: Sequence[Tensor],
) -> Float[Tensor, "centers out"]:
    """Linear layers with ReLU between them over every neighbour, then the maximum over the neighbours.

    Args:
        geometry: per-neighbour input.
        projected: features of the level below, already multiplied by their share of the first layer's weights
            (a linear layer over gathered features equals gathering the layer's output; speed reference, section 3).
        index: row of ``projected`` of each neighbour.
        weights: W1, b1, W2, b2, ...: each W as ``(out, in)``, W1 acting on ``geometry`` only.
    """
    hidden = torch.nn.functional.linear(geometry, weights[0], weights[1])
    if projected is not None:
        # [sources, c] -> [s, h, c]
        hidden = hidden + projected[index]
    for weight, bias in zip(weights[2::2], weights[3::2], strict=True):
        hidden = torch.nn.functional.linear(torch.relu(hidden), weight, bias)
    # [s, h, c] -> [s, c]
    return hidden.max(dim=1)[0]


def pooled_mlp(
    geometry: Float[Tensor, "centers neighbors channels"],
    projected: Float[Tensor, "sources width"] | None,
    index: Int[Tensor, "centers neighbors"],
    weights: Sequence[Tensor],
) -> Float[Tensor, "centers out"]:
    """``pooled_mlp_reference`` by the fastest means at hand; ``geometry`` gets no gradient.

    The C kernel serves float32 on a CPU with two to nine layers and widths that are multiples of 8; everything else,
    and tracing for export, takes the reference.
    """
    fits = geometry.shape[1] < MOST_NEIGHBORS and all(b.shape[0] % 8 == 0 for b in weights[1::2])
    fits = fits and 2 <= len(weights) // 2 <= MOST_LAYERS
    inputs = [geometry, *weights] if projected is None else [geometry, projected, *weights]
    if not fits or kernels(_FILE, *inputs) is None:
        return _in_pieces(geometry, projected, index, weights)
    result: Tensor = _PooledMLP.apply(geometry.detach(), projected, index.long(), *weights)
    return result


def _in_pieces(geometry: Tensor, projected: Tensor | None, index: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """``pooled_mlp_reference``, some centres at a time where no gradient needs the activations of all."""
    rows = max(1, MOST_NUMBERS // (geometry.shape[1] * max(b.shape[0] for b in weights[1::2])))
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or len(geometry) <= rows:
        return pooled_mlp_reference(geometry, projected, index, weights)
    pieces = zip(geometry.split(rows), index.split(rows), strict=True)
    return torch.cat([pooled_mlp_reference(piece, projected, rows_of, weights) for piece, rows_of in pieces])


def pooled_mlp_weights(channels: int, widths: Sequence[int]) -> nn.ParameterList:
    """Fresh weights of ``pooled_mlp``: W1, b1, W2, b2 ... from ``channels`` to each of ``widths`` (He et al. 2015)."""
    weights = nn.ParameterList()
    for a, b in pairwise([channels, *widths]):
        weights += [torch.randn(b, a) * math.sqrt(2.0 / a), torch.zeros(b)]
    return weights


class _PooledMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, geometry: Tensor, projected: Tensor | None, index: Tensor, *weights: Tensor) -> Tensor:
        geometry, index = geometry.contiguous(), index.contiguous()
        projected = None if projected is None else projected.contiguous()
        centers = geometry.shape[0]
        out = geometry.new_empty(centers, weights[-1].shape[0])
        winner = torch.empty(out.shape, dtype=torch.uint8)
        arguments = _arguments(geometry, projected, index, weights)
        library = kernels(_FILE)
        assert library is not None
        in_threads(
            centers,
            lambda _, a, b: native.call(library.pooled_forward, *arguments(a, b), out.numpy(), winner.numpy()),
            _least(geometry),
        )
        ctx.save_for_backward(geometry, projected, index, winner, *weights)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        geometry, projected, index, winner, *weights = ctx.saved_tensors
        grad_out = gradients[0].contiguous()
        arguments = _arguments(geometry, projected, index, weights)
        library = kernels(_FILE)
        assert library is not None
        transposed = _Pointers([w.detach().contiguous() for w in weights[0::2]])
        partial: list[tuple[list[Tensor], Tensor | None]] = []
        for _ in range(thread_count(len(geometry), _least(geometry))):
            # Narrow inputs: the first layer's gradient is gathered as (in, out) rows.
            sums = [torch.zeros(w.shape if i else w.T.shape) for i, w in enumerate(weights)]
            partial.append((sums, None if projected is None else torch.zeros_like(projected)))

        def run(thread: int, a: int, b: int) -> None:
            sums, grad_projected = partial[thread]
            native.call(
                library.pooled_backward,
                *arguments(a, b),
                transposed.array,
                winner.numpy(),
                grad_out.numpy(),
                _Pointers(sums[0::2]).array,
                _Pointers(sums[1::2]).array,
                None if grad_projected is None else grad_projected.numpy(),
            )

        in_threads(len(geometry), run, _least(geometry))
        sums, grad_projected = partial[0]
        for more, more_projected in partial[1:]:
            for total, part in zip(sums, more, strict=True):
                total += part
            if grad_projected is not None and more_projected is not None:
                grad_projected += more_projected
        return None, grad_projected, None, sums[0].T, *sums[1:]


def _least(geometry: Tensor) -> int:
    """Centres that are worth a thread: few, where each has many neighbours."""
    return min(LEAST_ROWS, max(1, 1024 // max(1, geometry.shape[1])))


class _Pointers:
    """A C array of pointers that keeps its tensors alive."""

    def __init__(self, tensors: list[Tensor]) -> None:
        self.tensors = tensors
        self.array = (ctypes.c_void_p * len(tensors))(*(t.data_ptr() for t in tensors))


def _arguments(
    geometry: Tensor, projected: Tensor | None, index: Tensor, weights: Sequence[Tensor]
) -> Callable[[int, int], tuple[object, ...]]:
    """The arguments that forward and backward share, for a range of centres."""
    widths = np.array([b.shape[0] for b in weights[1::2]], dtype=np.int32)
    rows = _Pointers([w.detach().T.contiguous() for w in weights[0::2]])
    biases = _Pointers([b.detach().contiguous() for b in weights[1::2]])
    _, neighbors, channels = geometry.shape
    source = None if projected is None else projected.detach().numpy()

    def arguments(start: int, stop: int) -> tuple[object, ...]:
        first, last = native.long(start), native.long(stop)
        sizes = (neighbors, channels)
        return (
            geometry.numpy(), first, last, *sizes, source, index.numpy(), len(widths), widths, rows.array, biases.array
        )  # fmt: skip

    arguments.keep = rows, biases  # type: ignore[attr-defined]
    return arguments
