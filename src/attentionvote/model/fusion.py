"""Fusion of gathered votes into one feature a proposal (paper section 3.3): the three modules of Table 8.

All take the locally normalised votes ``[z; g]``, z = (vote - centre seed) / voting radius, and share the first one's
MLP for the instance features; they differ in how the votes of a proposal become one:

* ``aml``, :class:`AttentionVoting`: weights from a second MLP (Fig. 3a), the paper's choice and the default;
* ``amx``, :class:`MatrixAttention`: weights from one trained matrix (Fig. 3b);
* ``pn``, :class:`PointNetPooling`: no weights, the maximum of each channel, as VoteNet's proposal module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import embedding  # a lookup; its gradient costs a third of an index's

from attentionvote.model.layers import RowNorm, shared_mlp
from attentionvote.section import located


class VoteBranch(nn.Module):
    """Shared MLP on the locally normalised votes ``[z; g]``, ending without norm and ReLU.

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
        # [b * m, c] -> [r, h, c]
        out: Tensor = self.rest(self.offset(offsets) + embedding(index, self.project(features)))
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
        # [r, h, c] -> [r, c]
        return (share * self.feature(offsets, features, index)).sum(1)


class MatrixAttention(nn.Module):
    """AMX, the matrix attention (Fig. 3b): as ``AttentionVoting``, but the weights come from one trained matrix.

    The paper says only that "the attention weights are obtained from the matrix product of vote features and weight
    matrix [...] which is set as the network parameter and trained directly". Read here: the H votes of a proposal as
    rows ``[z; g]`` times a matrix W ``(3 + F, width)`` give the weights ``(H, width)``, used as those of Fig. 3a
    are (softmax over the votes, Eq. 4). "Vote features" are taken for the module's input, as everywhere else in section
    3.3; what leaves the MLP is called "instance feature" there. No bias: the softmax would not see it.
    """

    def __init__(self, width_in: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.feature = VoteBranch(width_in, widths)
        # W in two blocks of rows, so that g's product is computed once a vote.
        self.weight_of_offset = nn.Linear(3, widths[-1], bias=False)
        self.weight_of_feature = nn.Linear(width_in, widths[-1], bias=False)
        self.width = widths[-1]

    def forward(
        self,
        offsets: Float[Tensor, "rows gathered 3"],
        features: Float[Tensor, "votes channels"],
        index: Int[Tensor, "rows gathered"],
    ) -> Float[Tensor, "rows out"]:
        """Proposal features; ``offsets`` are (vote - centre seed) / voting radius."""
        weight = self.weight_of_offset(offsets) + embedding(index, self.weight_of_feature(features))
        # [r, h, c] -> [r, c]
        return (torch.softmax(weight, dim=1) * self.feature(offsets, features, index)).sum(1)


class PointNetPooling(nn.Module):
    """PN, a PointNet over the gathered votes: shared MLP, then the maximum of each channel (VoteNet's fusion).

    The maximum comes before the last ReLU instead of after it, which is the same and touches fewer rows. The last layer
    has a bias in place of VoteNet's norm, as the feature branches of the two attentions it is compared with.
    """

    def __init__(self, width_in: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.feature = VoteBranch(width_in, widths)
        self.width = widths[-1]

    def forward(
        self,
        offsets: Float[Tensor, "rows gathered 3"],
        features: Float[Tensor, "votes channels"],
        index: Int[Tensor, "rows gathered"],
    ) -> Float[Tensor, "rows out"]:
        """Proposal features; ``offsets`` are (vote - centre seed) / voting radius."""
        # [r, h, c] -> [r, c]
        return torch.relu(self.feature(offsets, features, index).amax(1))


FUSIONS: dict[str, type[AttentionVoting] | type[MatrixAttention] | type[PointNetPooling]] = {
    "aml": AttentionVoting,
    "amx": MatrixAttention,
    "pn": PointNetPooling,
}


def fusion_class(kind: str) -> type[Any]:
    """The class of a name in ``FUSIONS``, or of a dotted name: one of the user's that is built and called as they are.

    Raises:
        ValueError: when it is neither.
    """
    if kind in FUSIONS:
        return FUSIONS[kind]
    fusion = located(kind)
    if not (isinstance(fusion, type) and issubclass(fusion, nn.Module)):
        raise ValueError(f"model.fusion_kind must be one of {', '.join(FUSIONS)} or a class of nn.Module; got {kind!r}")
    return fusion
