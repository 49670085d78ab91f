"""The few layers everything else is built from: linear + norm + ReLU blocks on rows of channels.

Linear on ``(rows, channels)`` instead of the usual 1x1 convolutions: the same arithmetic, several times faster on
a CPU. The normalisation is BatchNorm over rows, folded into the linear layer at export.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn


class RowNorm(nn.BatchNorm1d):
    """BatchNorm over all leading dimensions of ``(..., channels)``."""

    def forward(self, x: Float[Tensor, "*rows channels"]) -> Float[Tensor, "*rows channels"]:
        """Normalise each channel over the rows of the batch (running statistics in evaluation)."""
        # [..., c] -> [r, c] -> [..., c]
        return super().forward(x.reshape(-1, x.shape[-1])).view(x.shape)


def shared_mlp(width_in: int, widths: Sequence[int], last: int | None = None) -> nn.Sequential:
    """Linear + norm + ReLU for each of ``widths``, then a plain linear layer to ``last`` when given."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(width_in, width, bias=False), RowNorm(width), nn.ReLU(inplace=True)]
        width_in = width
    if last is not None:
        layers.append(nn.Linear(width_in, last))
    return nn.Sequential(*layers)


class Residual(nn.Module):
    """A pointwise residual block: x + MLP(x), then ReLU (PointNeXt's inverted residual without expansion)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(*shared_mlp(width, [width]), nn.Linear(width, width, bias=False), RowNorm(width))
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Float[Tensor, "*rows channels"]) -> Float[Tensor, "*rows channels"]:
        """Same shape as the input."""
        out: Tensor = self.relu(x + self.mlp(x))
        return out
