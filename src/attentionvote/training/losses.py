"""The losses of the paper (section 3.4, Eqs. 1-11) and the dense supervision that trains faster beside them.

Where several processes share a batch, every term is this process's part of the mean over the whole batch: the parts of
all processes add up to what one process would have computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.model.constants import Constant
from attentionvote.model.predictions import Poses, Votes
from attentionvote.model.proposals import Peaks
from attentionvote.part import Parts
from attentionvote.training.part_poses import PartPoses
from attentionvote.training.processes import summed
from attentionvote.training.settings import LossSettings, check_isotropic

QUALITY_STEPS = (0.02, 0.05, 0.10)  # of D: the thresholds of the evaluation
_QUALITY_STEPS = Constant(torch.tensor(QUALITY_STEPS, dtype=torch.float64))


class Assignment(NamedTuple):
    """Which instance every proposal row is trained towards.

    Attributes:
        sample: ``(rows,)`` sample of the batch.
        instance: ``(rows,)`` nearest visible instance.
        positive: ``(rows,)`` whether it is near enough to be supervised.
    """

    sample: Int[Tensor, " rows"]
    instance: Int[Tensor, " rows"]
    positive: Bool[Tensor, " rows"]


class AttentionVoteLoss:
    """All loss terms of one batch; the total is the weighted sum of the terms by name.

    Lengths are divided by 0.1 D, the limit of the evaluation, so that every term is of order one at the limit. Where
    several parts lie in one bin, D and symmetry of every row are those of the part that its instance is.

    Args:
        part: diameter and symmetry; or a set of parts.
        weights: weight of each term: ``vote`` (Eq. 1), ``vote_rotation`` (dense supervision: every vote's own
            rotation), ``center``, ``rotation``, ``semantic`` (Eq. 9), ``confidence`` (Eq. 10), ``refined`` (pose
            after the refinement, mean over its steps). A weight of 0 leaves a term out.
        settings: the choices.

    Raises:
        ValueError: with one sentence, on the weight of an unknown term, or a setting that the part has no use for.
    """

    TERMS = ("vote", "vote_rotation", "center", "rotation", "semantic", "confidence", "refined")

    def __init__(self, part: Parts, weights: Mapping[str, float], settings: LossSettings) -> None:
        unknown = sorted(set(weights) - set(self.TERMS))
        if unknown:
            raise ValueError(f"loss weights must be among {', '.join(self.TERMS)}, got {', '.join(unknown)}")
        check_isotropic(settings, part)
        self.weights, self.settings = dict(weights), settings
        self.training_pose = PartPoses.of(part, settings.isotropic)
        self.true_pose = PartPoses.of(part)

    def total(self, terms: Mapping[str, Tensor], ramp: float = 1.0) -> Tensor:
        """Weighted sum; ``ramp`` in [0, 1] scales all terms but the votes' (warm-up)."""
        weighted = [self.weights.get(k, 0.0) * v * (1.0 if k.startswith("vote") else ramp) for k, v in terms.items()]
        return torch.stack(weighted).sum()

    def vote_terms(self, votes: Votes, batch: Batch) -> dict[str, Tensor]:
        """Eq. (1), mean over the seeds that lie on an instance, and the votes' rotations."""
        # [b, n] -> [b, m]
        instance = torch.take_along_dim(batch.instance, votes.seed_index, dim=1)
        on_part = instance >= 0
        index = instance.clamp(min=0)
        rows = torch.arange(len(index), device=index.device)[:, None]
        # [b, i, ...] -> [b, m, ...], i instances of a sample
        aim, part = batch.center[rows, index], batch.part[rows, index]
        error = ((votes.xyz - aim).square().sum(-1) + 1e-12).sqrt() / self._unit(part, votes.xyz)
        terms = {"vote": masked_mean(error, on_part)}
        if votes.rotation is not None:
            # [b, m, ...] -> [b * m, ...]
            turn = self.training_pose.rotation_loss(
                "metric",
                part.flatten(),
                votes.rotation.new_zeros(0, 4),
                votes.rotation.flatten(0, 1),
                batch.rotation[rows, index].flatten(0, 1),
            )
            # [b * m] -> [b, m]
            terms["vote_rotation"] = masked_mean(turn.view_as(error), on_part)
        return terms

    def assign(self, peaks: Peaks, batch: Batch, rows: Int[Tensor, " rows"]) -> Assignment:
        """The nearest visible instance of every proposal, whatever its part (paper, "Assigning instance labels")."""
        sample = rows // peaks.heat.shape[1]
        # [b, k, 3] -> [b * k, 3] -> [r, 3]
        seed = peaks.center_seed.flatten(0, 1)[rows]
        # [r, 1, 3] - [r, i, 3] -> [r, i]
        distance = (seed[:, None] - batch.center[sample]).norm(dim=-1)
        visible = batch.visible[sample]
        # Padding has visibility 0 and lies at the origin.
        distance = distance.masked_fill((visible <= 0) | (visible < self.settings.least_visible), torch.inf)
        nearest, instance = distance.min(dim=1)
        limit = self.settings.assignment * self.true_pose.diameter(batch.part[sample, instance], seed.dtype)
        return Assignment(sample, instance, nearest < limit)

    def proposal_terms(self, poses: Poses, assigned: Assignment, batch: Batch) -> dict[str, Tensor]:
        """Eq. (9) of the positive proposals, term by term, mean over them."""
        part, center, rotation = self._truth(assigned, batch)
        settings = self.settings
        apart = ((poses.center - center).square().sum(-1) + 1e-12).sqrt() / self._unit(part, poses.center)
        turn = self.training_pose.rotation_loss(settings.rotation, part, poses.quaternion, poses.rotation, rotation)
        terms = {"center": masked_mean(apart, assigned.positive), "rotation": masked_mean(turn, assigned.positive)}
        semantic = torch.zeros_like(apart)
        if poses.class_logits.shape[1] > 1:
            semantic = torch.nn.functional.cross_entropy(poses.class_logits, part, reduction="none")
            terms["semantic"] = masked_mean(semantic, assigned.positive)
        if settings.confidence == "exponential":
            weights = {k: self.weights.get(k, 0.0) for k in ("center", "rotation", "semantic")}
            instance = weights["center"] * apart + weights["rotation"] * turn + weights["semantic"] * semantic
            instance = instance.detach() if settings.detach_confidence else instance
            score = poses.score.clamp(-8, 8)
            terms["confidence"] = masked_mean(instance * score.exp() - score, assigned.positive)
        return terms

    def refined_term(self, poses: Poses, assigned: Assignment, batch: Batch) -> Tensor:
        """Distance after a step of the refinement: centre and rotation together, as the evaluation measures it."""
        part, center, rotation = self._truth(assigned, batch)
        turn = self.training_pose.squared_turn(part, poses.rotation, rotation)
        squared = turn + (poses.center - center).square().sum(-1)
        return masked_mean((squared + 1e-10).sqrt() / self._unit(part, poses.center), assigned.positive)

    def quality_term(self, poses: Poses, assigned: Assignment, batch: Batch) -> dict[str, Tensor]:
        """Cross entropy between the predicted and the measured quality of every proposal."""
        with torch.no_grad():
            quality = self.quality(poses, assigned, batch)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(poses.score, quality, reduction="none")
        return {"confidence": masked_mean(loss, torch.ones_like(loss, dtype=torch.bool))}

    def quality(self, poses: Poses, assigned: Assignment, batch: Batch) -> Float[Tensor, " rows"]:
        """Share of the thresholds 2, 5, 10 % D that each pose meets; see ``LossSettings.one_per_instance``.

        With several parts a pose under the name of another part is worth nothing, as in the evaluation.
        """
        part, center, rotation = self._truth(assigned, batch)
        distance = self.true_pose.distance(part, poses.center, poses.rotation, center, rotation)
        right = assigned.positive
        if poses.class_logits.shape[1] > 1:
            right = right & (poses.class_logits.argmax(1) == part)
        distance = distance.masked_fill(~right, torch.inf)
        share = distance / self.true_pose.diameter(part, distance.dtype)
        # [r, 1] < [3] -> [r, 3] -> [r]
        quality = (share[:, None] < _QUALITY_STEPS.like(share)).to(poses.score.dtype).mean(1)
        if not self.settings.one_per_instance:
            return quality
        # [r] -> row of [b * i], one a sample's instance
        key = assigned.sample * batch.visible.shape[1] + assigned.instance
        best = torch.full((int(batch.visible.numel()),), torch.inf, dtype=distance.dtype, device=distance.device)
        best = best.scatter_reduce(0, key, distance, "amin")
        return quality * (distance <= best[key])

    def _truth(self, assigned: Assignment, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Part, centre and rotation of every row's instance."""
        at = assigned.sample, assigned.instance
        # [b, i, ...] -> [r, ...]
        return batch.part[at], batch.center[at], batch.rotation[at]

    def _unit(self, part: Int[Tensor, "*rows"], lengths: Tensor) -> Float[Tensor, "*rows"] | float:
        """0.1 D of every row's part, metres, in the precision of the ``lengths`` that it divides."""
        return 0.1 * self.true_pose.diameter(part, lengths.dtype)


def masked_mean(values: Float[Tensor, "*rows"], mask: Bool[Tensor, "*rows"]) -> Float[Tensor, ""]:
    """Sum of the values where ``mask`` holds over their number in all processes; 0 with gradient 0 where it never does.

    In a process of its own that is the mean; the values of several processes add up to the mean over all.
    """
    weight = mask.to(values.dtype)
    return (values.masked_fill(~mask, 0.0) * weight).sum() / summed(weight.sum()).clamp(min=1.0)
