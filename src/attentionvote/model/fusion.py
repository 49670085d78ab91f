"""From gathered votes to one feature per proposal (paper section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.model.layers import RowNorm, shared_mlp


class VoteBranch(nn.Module):
    """Shared MLP on the locally normalised votes ``[z; g]``, ending without ReLU.

    The first layer's share of the vote feature g is computed once a vote and gathered afterwards.
    """

    def __init__(self, width_in: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.project = nn.Linear(width_in, widths[0], bias=False)
        self.offset = nn.Linear(3, widths[0], bias=False)
        self.rest = nn.Sequential(
            RowNorm(widths[0]), nn.ReLU(inplace=True), *shared_mlp(widths[0], widths[1:-1], widths[-1])
        )

    def forward(
        self,
        offsets: Float[Tensor, "rows gathered 3"],
        features: Float[Tensor, "votes channels"],
        index: Int[Tensor, "rows gathered"],
    ) -> Float[Tensor, "rows gathered out"]:
        """Features of the gathered votes; ``index`` are rows of ``features``."""
        out: Tensor = self.rest(self.offset(offsets) + self.project(features)[index])
        return out


class AttentionVoting(nn.Module):
    """AML, the shared-MLP attention (Fig. 3a, Eq. 4): a weighted sum of votes, each channel with its own weights.

    Two branches of one structure give instance features and attention weights; a softmax over the gathered votes
    turns the weights into shares.
    """

    def __init__(self, width_in: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.feature = VoteBranch(width_in, widths)
        self.weight = VoteBranch(width_in, widths)
        self.width = widths[-1]

    def forward(
        self,
        offsets: Float[Tensor, "rows gathered 3"],
        features: Float[Tensor, "votes channels"],
        index: Int[Tensor, "rows gathered"],
    ) -> Float[Tensor, "rows out"]:
        """Proposal features; ``offsets`` are (vote - centre seed) / voting radius."""
        share = torch.softmax(self.weight(offsets, features, index), dim=1)
        return (share * self.feature(offsets, features, index)).sum(1)
