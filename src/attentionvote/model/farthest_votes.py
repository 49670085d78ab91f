"""Centre seeds as VoteNet takes them: farthest-point sampling of the votes (paper section 3.2, the alternative).

The paper's objection is that sampling "neglects the spatial distribution pattern of votes", so that proposals "may
deviate from the ground-truth centers or overlap on the same one"; training's figures ``proposal_*`` count both.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.model.proposals import Peaks


class FarthestVotes(nn.Module):
    """Farthest-point order of the votes; a module, so that the exporter can replace it."""

    def forward(self, votes: Float[Tensor, "batch votes 3"], count: int) -> Int[Tensor, "batch count"]:
        """Indices of ``count`` votes of each sample, each the farthest from all before it, from vote 0 on.

        Ties go to the lowest index, so that every device and the exported graph choose the same votes. Plain torch
        everywhere: some hundred tiny operations, milliseconds beside the rest of the network.
        """
        x, y, z = votes.unbind(-1)
        nearest = torch.full_like(x, torch.inf)
        last = torch.zeros(len(votes), 1, dtype=torch.long, device=votes.device)
        order = [last]
        for _ in range(count - 1):
            # [b, m] - [b, 1]
            dx, dy, dz = (a - torch.take_along_dim(a, last, dim=1) for a in (x, y, z))
            nearest = torch.minimum(nearest, dx * dx + dy * dy + dz * dz)
            last = nearest.argmax(1, keepdim=True)
            order.append(last)
        return torch.cat(order, dim=1)


def farthest_vote_peaks(votes: Float[Tensor, "batch votes 3"], order: Int[Tensor, "batch count"]) -> Peaks:
    """Sampled votes as proposals: each one's position is its centre seed.

    There is no heat, and VoteNet has no threshold: heat is 1 for every vote, so that a peak threshold of at most 1
    passes all, and 0 for a proposal at the very place of an earlier one, which sampling takes when there are fewer
    distinct votes than proposals.

    Args:
        votes: metres.
        order: indices of the sampled votes.
    """
    # [b, m, 3] -> [b, k, 3]
    seed = torch.take_along_dim(votes, order[..., None], dim=1)
    index = torch.arange(order.shape[1], device=votes.device)
    # [b, k, 1, 3] - [b, 1, k, 3] -> [b, k, k]
    apart = (seed[:, :, None] - seed[:, None]).abs().amax(-1)
    repeated = ((apart == 0) & (index[None, :] < index[:, None])).any(-1)
    return Peaks(seed, 1.0 - repeated.to(votes.dtype), torch.ones_like(votes[..., 0]))
