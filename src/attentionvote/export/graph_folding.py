"""Norms of a trained network folded into the linear layers before them: half of the passes over their rows.

In evaluation a norm multiplies and adds numbers that are known. onnxruntime folds none of those that torch exports, and
its own norm of rows is slow.
"""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding, linear

from attentionvote.model.fusion import VoteBranch
from attentionvote.model.layers import RowNorm


class GraphNorm(nn.Module):
    """``RowNorm`` in evaluation."""

    def __init__(self, norm: RowNorm) -> None:
        super().__init__()
        assert norm.running_mean is not None
        assert norm.running_var is not None
        scale = norm.weight.detach() / (norm.running_var + norm.eps).sqrt()
        self.scale: Tensor
        self.shift: Tensor
        self.register_buffer("scale", scale)
        self.register_buffer("shift", norm.bias.detach() - norm.running_mean * scale)

    def forward(self, x: Float[Tensor, "*rows channels"]) -> Float[Tensor, "*rows channels"]:
        """Same shape as the input."""
        return x * self.scale + self.shift


def folded(layers: nn.Sequential) -> nn.Sequential:
    """The same layers, each linear one together with the norm behind it."""
    result: list[nn.Module] = []
    for layer in layers:
        if isinstance(layer, GraphNorm) and result and isinstance(result[-1], nn.Linear):
            result[-1] = _normed(result[-1], layer, bias=True)
        else:
            result.append(layer)
    return nn.Sequential(*result)


class GraphVoteBranch(nn.Module):
    """``VoteBranch`` whose layers were replaced: the first norm goes into both parts of the layer before it."""

    def __init__(self, branch: VoteBranch) -> None:
        super().__init__()
        norm, *rest = branch.rest
        assert isinstance(norm, GraphNorm)
        self.project, self.offset = _normed(branch.project, norm, bias=False), _normed(branch.offset, norm, bias=True)
        self.rest = nn.Sequential(*rest)

    def forward(
        self,
        offsets: Float[Tensor, "rows gathered 3"],
        features: Float[Tensor, "votes channels"],
        index: Int[Tensor, "rows gathered"],
    ) -> Float[Tensor, "rows gathered out"]:
        """Features of the gathered votes; ``index`` are rows of ``features``."""
        flat = linear(offsets.flatten(0, 1), self.offset.weight, self.offset.bias)
        out: Tensor = self.rest(flat + embedding(index.flatten(), self.project(features)))
        return out.view(*index.shape, -1)


def _normed(layer: nn.Linear, norm: GraphNorm, bias: bool) -> nn.Linear:
    """A linear layer and what the norm behind it does to its answer; without the norm's shift unless ``bias``."""
    assert bias or layer.bias is None
    result: nn.Linear = nn.utils.skip_init(nn.Linear, layer.in_features, layer.out_features, bias=bias)
    result.weight.data = layer.weight.detach() * norm.scale[:, None]
    if bias:
        before = 0 if layer.bias is None else layer.bias.detach() * norm.scale
        result.bias.data = norm.shift + before
    return result
