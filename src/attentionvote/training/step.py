"""The forward pass of a training step: votes, proposals, refinement, and the loss terms of a batch."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.model.network import AttentionVote
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.processes import everyones, rank


def batch_loss(
    model: AttentionVote, loss: AttentionVoteLoss, batch: Batch, ramp: float, least_heat: float
) -> dict[str, Tensor]:
    """All loss terms of one batch (Eq. 11), this process's part of them.

    Args:
        ramp: 0 during the warm-up, when only the votes are trained; the proposals are then not computed at all.
        least_heat: proposals with less heat are left out of training; so are places beyond the last peak (heat 0).
    """
    votes = model.cast_votes(batch.points, batch.normals, batch.neighborhoods)
    terms = loss.vote_terms(votes, batch)
    if ramp <= 0:
        return terms
    peaks = model.find_peaks(votes)
    # [b, k] -> [b * k]
    heat = peaks.heat.flatten()
    rows = torch.nonzero((heat >= least_heat) & (heat > 0))[:, 0]
    rows, selected_count = _even_choice(rows, loss.settings.rows_per_scene * len(batch.points), len(heat))
    if selected_count < 2:  # batch statistics need two rows
        return terms
    poses = model.regress(votes, peaks, rows)
    assigned = loss.assign(peaks, batch, rows)
    terms |= loss.proposal_terms(poses, assigned, batch)
    final = poses
    steps = model.refine(batch.points, batch.normals, assigned.sample, poses)
    if steps:
        final = steps[-1]
        terms["refined"] = torch.stack([loss.refined_term(step, assigned, batch) for step in steps]).mean()
    if loss.settings.confidence == "quality":
        terms |= loss.quality_term(final, assigned, batch)
    return terms


def _even_choice(rows: Int[Tensor, " rows"], most: int, places: int) -> tuple[Int[Tensor, " selected"], int]:
    """Every n-th row of the whole batch, so that ``most`` a process are left at most on average.

    Args:
        rows: this process's, in rising order, counted from its own first place.
        most: rows a process.
        places: rows that each process could have; the whole batch is the processes' places one after the other.

    Returns:
        this process's share of the choice, and the number of all selected rows.
    """
    totals = everyones(torch.stack([rows.new_full((), len(rows)), rows.sum()])).tolist()
    count = sum(size for size, _ in totals)
    stride = -(-count // (most * len(totals)))
    if stride <= 1:
        return rows, count
    # Which ones is as good as random, and the same in a continued training.
    first = sum(total + size * places * process for process, (size, total) in enumerate(totals)) % stride
    before = sum(size for size, _ in totals[: rank()])
    return rows[(first - before) % stride :: stride], len(range(first, count, stride))
