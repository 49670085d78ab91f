"""AttentionVote: points and normals in, poses of all instances out (paper section 3, Fig. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.model.backbone import Backbone
from attentionvote.model.farthest_votes import FarthestVotes, farthest_vote_peaks
from attentionvote.model.fusion import FUSIONS, FusionKind
from attentionvote.model.layers import shared_mlp
from attentionvote.model.neighborhoods import Layout, Neighborhoods, find_batch
from attentionvote.model.precision import widened
from attentionvote.model.predictions import Poses, Predictions, Votes
from attentionvote.model.proposals import Heatmap, Peaks, gather_votes, heatmap_peaks
from attentionvote.model.refinement import Refined, Refiner
from attentionvote.model.rotation import (
    matrix_from_quaternion,
    matrix_from_six,
    quaternion_from_matrix,
    unit_quaternion,
)


class AttentionVote(nn.Module):
    """The network. Lengths are given as fractions of the diameter D, so one preset fits parts of every size.

    Args:
        diameter: D of the (largest) part in metres.
        box: lowest and highest corner of the part in its own frame, metres; only the refinement looks at it.
        centers, neighbors, widths, propagation, residual: the backbone (see ``Layout`` and ``Backbone``).
        base_radius: r in metres; None takes ``radius_fraction`` x D. Levels have r, 2r, 3r and 6r.
        voxel_size: of the heatmap in metres; None takes ``voxel_fraction`` x D.
        voting_radius: radius in which votes are gathered, metres; None takes r. May be set during training.
        test_voting_radius: the same outside training (Table 9); None takes ``voting_radius``.
        voting: hidden widths of the voting module.
        vote_rotation: whether every vote also predicts its instance's rotation: dense supervision, not in the paper.
        proposal_source: ``heatmap`` (section 3.2) or ``fps``, VoteNet's farthest-point sampling of the votes.
        proposals: K.
        peak_window, center_seed: see ``heatmap_peaks``.
        gathered: H, votes gathered for a proposal.
        fusion_kind: ``aml``, ``amx`` or ``pn`` (Table 8), see ``model.fusion``.
        fusion: widths of the fusion's MLPs (section 3.5: 128, 128, 128).
        head: hidden widths of the head.
        classes: NC.
        rotation: ``quaternion`` (the paper's) or ``six`` (Gram-Schmidt of two vectors).
        confidence: ``exponential`` (c = exp(s), Eq. 10) or ``quality`` (c = sigmoid(s), the expected quality).
        refinement: arguments of ``Refiner`` (points, widths, head), None for the paper's form.
        refinement_steps: refiners in a row.
        merge_fraction: of several proposals whose final centres lie within this share of D (at most half of the part's
            smallest extent, so that stacked parts stay apart) only the most confident keeps its confidence, the others
            get 0; None leaves it to the peaks alone, as in the paper.

    Raises:
        ValueError: on an unknown choice, or an impossible layout.
    """

    def __init__(
        self,
        diameter: float,
        box: Sequence[Sequence[float]],
        centers: Sequence[int],
        neighbors: Sequence[int],
        widths: Sequence[Sequence[int]],
        propagation: Sequence[int],
        residual: bool,
        radius_fraction: float,
        voxel_fraction: float,
        voting: Sequence[int],
        proposals: int,
        gathered: int,
        fusion: Sequence[int],
        head: Sequence[int],
        base_radius: float | None = None,
        voxel_size: float | None = None,
        voting_radius: float | None = None,
        test_voting_radius: float | None = None,
        vote_rotation: bool = False,
        proposal_source: Literal["heatmap", "fps"] = "heatmap",
        peak_window: int = 1,
        center_seed: Literal["voxel", "mean"] = "voxel",
        fusion_kind: FusionKind = "aml",
        classes: int = 1,
        rotation: Literal["quaternion", "six"] = "quaternion",
        confidence: Literal["exponential", "quality"] = "exponential",
        refinement: dict | None = None,
        refinement_steps: int = 2,
        merge_fraction: float | None = None,
    ) -> None:
        super().__init__()
        for name, value, choices in (
            ("proposal_source", proposal_source, ("heatmap", "fps")),
            ("fusion_kind", fusion_kind, tuple(FUSIONS)),
            ("center_seed", center_seed, ("voxel", "mean")),
            ("rotation", rotation, ("quaternion", "six")),
            ("confidence", confidence, ("exponential", "quality")),
        ):
            if value not in choices:
                raise ValueError(f"{name} must be {' or '.join(choices)}, got {value!r}")
        self.diameter = diameter
        radius = base_radius or radius_fraction * diameter
        self.voxel_size = voxel_size or voxel_fraction * diameter
        self.voting_radius = voting_radius or radius
        self.test_voting_radius = test_voting_radius
        self.layout = Layout(tuple(centers), tuple(neighbors), tuple(radius * k for k in (1, 2, 3, 6)))
        self.proposals, self.gathered, self.classes = proposals, gathered, classes
        self.peak_window, self.center_seed = peak_window, center_seed
        self.rotation, self.confidence = rotation, confidence
        thinnest = min(high - low for low, high in zip(*box, strict=True))
        self.merge_radius = None if merge_fraction is None else min(merge_fraction * diameter, 0.5 * thinnest)
        self.backbone = Backbone(self.layout, widths, propagation, residual)
        width = self.backbone.width
        self.vote = shared_mlp(width, voting, 3 + width)
        rotation_size = 4 if rotation == "quaternion" else 6
        self.vote_rotation = nn.Linear(width, rotation_size) if vote_rotation else None
        # A module without weights: the exporter puts its own in its place.
        self.farthest = FarthestVotes() if proposal_source == "fps" else None
        self.heatmap = Heatmap()
        self.fusion = FUSIONS[fusion_kind](width, fusion)
        self.head = shared_mlp(self.fusion.width, head)
        self.output = nn.Linear(head[-1], 3 + rotation_size + classes + 1)
        last = self.vote[-1]
        assert isinstance(last, nn.Linear)
        nn.init.normal_(last.weight, std=0.01)
        steps = 0 if refinement is None else refinement_steps
        # A cascade: what is left to correct after one step is another, finer problem than before it.
        self.refiners = nn.ModuleList(
            Refiner(diameter, box, context=head[-1], **(refinement or {})) for _ in range(steps)
        )

    def cast_votes(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        found: Neighborhoods,
    ) -> Votes:
        """Seeds and their votes (section 3.1); offsets leave the network in units of half a diameter."""
        seed_xyz, seed_feature = self.backbone(points, normals, found)
        residual = self.vote(seed_feature)
        xyz = seed_xyz + residual[..., :3] * (0.5 * self.diameter)
        feature = seed_feature + residual[..., 3:]
        rotation = None if self.vote_rotation is None else self._matrix(widened(self.vote_rotation(feature)))
        return Votes(found.order[:, : self.layout.seeds], xyz, feature, rotation)

    def find_peaks(self, votes: Votes) -> Peaks:
        """The K hottest peaks of the votes' heatmap or K farthest votes (section 3.2), without gradient to them."""
        xyz = votes.xyz.detach()
        if self.farthest is not None:
            return farthest_vote_peaks(xyz, self.farthest(xyz, min(self.proposals, xyz.shape[1])))
        return heatmap_peaks(xyz, self.voxel_size, self.proposals, self.peak_window, self.center_seed, self.heatmap)

    def regress(self, votes: Votes, peaks: Peaks, rows: Int[Tensor, " rows"] | None = None) -> Poses:
        """Poses of proposals from the votes around them (sections 3.3, 3.4).

        Outside training the votes come from the test radius, but offsets stay in units of the training's: an offset of
        some millimetres means to the network what it meant then.

        Args:
            rows: flat indices into ``(batch, K)`` of the proposals wanted; all when None.
        """
        batch, _, _ = peaks.center_seed.shape
        radius = self.voting_radius if self.training else self.test_voting_radius or self.voting_radius
        index = gather_votes(votes.xyz.detach(), peaks.center_seed, radius, self.gathered)
        first_row = torch.arange(batch, device=index.device)[:, None, None] * votes.xyz.shape[1]
        index = (index + first_row).flatten(0, 1)
        seed = peaks.center_seed.flatten(0, 1)
        if rows is not None:
            index, seed = index[rows], seed[rows]
        offsets = (votes.xyz.flatten(0, 1)[index] - seed[:, None]) / self.voting_radius
        fused = self.fusion(offsets, votes.feature.flatten(0, 1), index)
        feature = self.head(fused)
        out = widened(self.output(feature))
        center = seed + out[:, :3] * (0.1 * self.diameter)
        raw = out[:, 3 : -1 - self.classes]
        rotation = self._matrix(raw)
        quaternion = unit_quaternion(raw) if self.rotation == "quaternion" else quaternion_from_matrix(rotation)
        return Poses(center, rotation, quaternion, out[:, -1 - self.classes : -1], out[:, -1], feature)

    def refine(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        sample: Int[Tensor, " rows"],
        poses: Poses,
    ) -> list[Poses]:
        """The poses after every step of the refinement, each with its own score; ``sample`` names each row's sample."""
        steps = []
        for refiner in self.refiners:
            better: Refined = refiner(points, normals, sample, poses.center, poses.rotation, poses.feature)
            quaternion = quaternion_from_matrix(better.rotation)
            poses = Poses(better.center, better.rotation, quaternion, poses.class_logits, better.score, poses.feature)
            steps.append(poses)
        return steps

    def forward(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        found: Neighborhoods | None = None,
    ) -> Predictions:
        """Poses of all instances.

        Args:
            points: metres, camera frame, in random order.
            normals: unit, towards the camera.
            found: neighbourhoods when they are known already.
        """
        if found is None:
            found = find_batch(points, self.layout)
        votes = self.cast_votes(points, normals, found)
        peaks = self.find_peaks(votes)
        poses = self.regress(votes, peaks)
        batch, k = peaks.heat.shape
        sample = torch.arange(batch, device=points.device).repeat_interleave(k)
        if len(self.refiners):
            poses = self.refine(points, normals, sample, poses)[-1]

        def shaped(rows: Tensor) -> Tensor:
            return rows.view(batch, k, *rows.shape[1:])

        return Predictions(
            votes.xyz,
            peaks.center_seed,
            peaks.heat,
            shaped(poses.center),
            shaped(poses.quaternion),
            shaped(poses.class_logits),
            self.merge(shaped(poses.center), shaped(self.confidence_of(poses.score)), peaks.heat),
        )

    def merge(
        self,
        center: Float[Tensor, "batch proposals 3"],
        confidence: Float[Tensor, "batch proposals"],
        heat: Float[Tensor, "batch proposals"],
    ) -> Float[Tensor, "batch proposals"]:
        """Confidence 0 for a proposal that ended where a more confident one (or an equal, hotter one) ended.

        Votes of one instance that lie apart make two peaks; the refinement moves both onto the instance, and only
        there can be told that they are one. The paper leaves duplicates to the peaks alone (no suppression of any
        kind, ``merge_fraction`` None); peaks fine enough to find half-hidden instances then double the visible ones.
        """
        if self.merge_radius is None:
            return confidence
        valid = torch.where(heat > 0, confidence, torch.full_like(confidence, -1.0))
        near = (center[:, :, None] - center[:, None]).square().sum(-1) < self.merge_radius**2
        index = torch.arange(center.shape[1], device=center.device)
        ahead = (valid[:, None] > valid[:, :, None]) | (
            (valid[:, None] == valid[:, :, None]) & (index[None, :] < index[:, None])
        )
        return torch.where((near & ahead).any(-1), torch.zeros_like(confidence), confidence)

    def confidence_of(self, score: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows"]:
        """Confidence of a score: exp(s) with s clamped to +-8 (Eq. 10), or sigmoid(s)."""
        return torch.sigmoid(score) if self.confidence == "quality" else score.clamp(-8, 8).exp()

    def _matrix(self, raw: Tensor) -> Tensor:
        return matrix_from_quaternion(raw) if self.rotation == "quaternion" else matrix_from_six(raw)
