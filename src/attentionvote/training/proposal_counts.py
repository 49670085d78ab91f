"""Coverage of a scene's instances by the proposals: is any left out, is any proposed twice?

The paper says that its heatmap avoids what sampling does: proposals that "may deviate from the ground-truth centers or
overlap on the same one" (section 3.2). That is a claim about proposals, so it is counted on proposals: before the
network regresses, refines or merges anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.samples import Batch
from attentionvote.model.predictions import Predictions

LEAST_VISIBLE = 0.5  # what must be found, as in the evaluation


class ProposalCounts(NamedTuple):
    """Of one scene.

    Attributes:
        proposals: how many there are.
        required: instances that are visible enough to be asked for.
        proposed: those of the required that have a proposal.
        repeats: proposals beyond the first on one instance, required or not.
        strays: proposals on no instance.
    """

    proposals: int
    required: int
    proposed: int
    repeats: int
    strays: int


def proposal_counts(
    predictions: Predictions, batch: Batch, peak_threshold: float, radius: float | Sequence[float]
) -> list[ProposalCounts]:
    """Counts of every sample of a batch.

    A proposal stands on the instance whose centre is nearest to its centre seed, if within ``radius``: the paper's
    assignment of labels. So one proposal never covers two instances.

    Args:
        predictions: of the batch.
        batch: with the truth; instances that cannot be seen at all, padded ones among them, are left out.
        peak_threshold: proposals with less heat do not count, nor do places without a peak (heat 0).
        radius: metres; of several parts one for the instances of each.
    """
    heat, seed = predictions.peak_heat.float().cpu().numpy(), predictions.center_seed.double().cpu().numpy()
    center, visible = batch.center.double().cpu().numpy(), batch.visible.double().cpu().numpy()
    reach = np.atleast_1d(np.asarray(radius, dtype=np.float64))
    reach = reach[batch.part.cpu().numpy()] if len(reach) > 1 else np.broadcast_to(reach, visible.shape)
    hot, seen = (heat >= peak_threshold) & (heat > 0), visible > 0
    return [
        _counts(seed[i, hot[i]], center[i, seen[i]], visible[i, seen[i]] >= LEAST_VISIBLE, reach[i, seen[i]])
        for i in range(len(seed))
    ]


def _counts(
    seed: NDArray[np.float64], center: NDArray[np.float64], required: NDArray[np.bool_], reach: NDArray[np.float64]
) -> ProposalCounts:
    on = np.zeros(len(center), dtype=np.int64)
    if len(seed) and len(center):
        apart = np.linalg.norm(seed[:, None] - center, axis=-1)
        near = apart.min(1) < reach[apart.argmin(1)]
        on = np.bincount(apart.argmin(1)[near], minlength=len(center))
    repeats, strays = int(np.maximum(on - 1, 0).sum()), len(seed) - int(on.sum())
    return ProposalCounts(len(seed), int(required.sum()), int((on[required] > 0).sum()), repeats, strays)


def proposal_figures(counts: Sequence[ProposalCounts]) -> dict[str, float]:
    """Flat figures over scenes.

    * ``proposal_recall``: share of the required instances that have a proposal (what is missing is the omission);
      absent when nothing is required;
    * ``proposal_repeats``, ``proposal_strays``, ``proposal_count``: numbers over all scenes.
    """
    total = ProposalCounts(*(sum(values) for values in zip(*counts, strict=True))) if counts else None
    if total is None:
        return {}
    figures = {
        "proposal_repeats": float(total.repeats),
        "proposal_strays": float(total.strays),
        "proposal_count": float(total.proposals),
    }
    return figures | ({"proposal_recall": total.proposed / total.required} if total.required else {})
