"""AttentionVote: points and normals in, poses of all instances out (paper section 3, Fig. 1).

Letters of the shapes in the comments of ``model`` and ``training``: b samples of the batch, n points of a sample, i its
instances, s centres of a level, m votes (one a seed), k proposals (K), h votes gathered for a proposal (H) or
neighbours of a centre, c channels, g members of a symmetry group, r rows (proposals of all samples, or those asked
for).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from attentionvote.model.backbone import Backbone
from attentionvote.model.farthest_votes import FarthestVotes, farthest_vote_peaks
from attentionvote.model.fusion import fusion_class
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
from attentionvote.model.settings import NetworkSettings
from attentionvote.section import read


class PoseChannels(NamedTuple):
    """Channels of the head's output: which of them mean what.

    Attributes:
        offset: from the centre seed to the centre, in units of 0.1 D.
        rotation: of the parametrisation that is chosen.
        class_logits: one a class.
        score: see ``Poses``.
    """

    offset: slice
    rotation: slice
    class_logits: slice
    score: int

    @classmethod
    def of(cls, rotation_size: int, classes: int) -> PoseChannels:
        """The channels one after the other."""
        first_class = 3 + rotation_size
        return cls(slice(0, 3), slice(3, first_class), slice(first_class, first_class + classes), first_class + classes)

    @property
    def width(self) -> int:
        """Channels in all."""
        return self.score + 1


class AttentionVote(nn.Module):
    """The network.

    Args:
        settings: sizes and choices, the group ``conf/model``. Of several proposals whose final centres lie within
            ``merge_fraction`` x D (at most half of the part's smallest extent, so that stacked parts stay apart) only
            the most confident keeps its confidence, the others get 0.
        diameter: D of the (largest) part in metres.
        box: lowest and highest corner of the part in its own frame, metres; of refinement and merging.

    Attributes:
        voting_radius: in which votes are gathered, metres; may be set during training.
        test_voting_radius: the same outside training (Table 9); None takes ``voting_radius``. Training gathers widely,
            so that early, scattered votes teach too; in a test fewer votes of neighbours are then among a part's own.

    Raises:
        ValueError: on an impossible layout.
    """

    def __init__(self, settings: NetworkSettings, diameter: float, box: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.diameter = diameter
        radius = settings.base_radius or settings.radius_fraction * diameter
        self.voxel_size = settings.voxel_size or settings.voxel_fraction * diameter
        self.voting_radius = settings.voting_radius or radius
        self.test_voting_radius = settings.test_voting_radius
        if self.test_voting_radius is None and settings.test_voting_share != 1:
            self.test_voting_radius = settings.test_voting_share * self.voting_radius
        radii = tuple(radius * factor for factor in (1, 2, 3, 6))
        self.layout = Layout(tuple(settings.centers), tuple(settings.neighbors), radii)
        self.proposals, self.gathered, self.classes = settings.proposals, settings.gathered, settings.classes
        self.peak_window, self.center_seed = settings.peak_window, settings.center_seed
        self.rotation, self.confidence = settings.rotation, settings.confidence
        self.merge_radius: float | None = None
        if settings.merge_fraction is not None:
            thinnest = min(high - low for low, high in zip(*box, strict=True))
            self.merge_radius = min(settings.merge_fraction * diameter, 0.5 * thinnest)
        # The modules' order is that of the random numbers: another one would be another network for the same seed.
        self.backbone = Backbone(self.layout, settings.widths, settings.propagation, settings.residual)
        width = self.backbone.width
        self.vote = shared_mlp(width, settings.voting, 3 + width)
        rotation_size = 4 if settings.rotation == "quaternion" else 6
        self.vote_rotation = nn.Linear(width, rotation_size) if settings.vote_rotation else None
        # A module without weights: the exporter puts its own in its place.
        self.farthest = FarthestVotes() if settings.proposal_source == "fps" else None
        self.heatmap = Heatmap()
        self.fusion = fusion_class(settings.fusion_kind)(width, settings.fusion)
        self.head = shared_mlp(self.fusion.width, settings.head)
        self.channels = PoseChannels.of(rotation_size, settings.classes)
        self.output = nn.Linear(settings.head[-1], self.channels.width)
        last = self.vote[-1]
        assert isinstance(last, nn.Linear)
        nn.init.normal_(last.weight, std=0.01)
        # A cascade: what is left to correct after one step is another, finer problem than before it.
        self.refiners = nn.ModuleList()
        if settings.refinement is not None:
            for _ in range(settings.refinement_steps):
                self.refiners.append(Refiner(settings.refinement, diameter, box, context=settings.head[-1]))

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any]) -> AttentionVote:
        """The network of a flat dictionary, as checkpoints keep it: the settings, ``diameter`` and ``box``.

        Raises:
            KeyError: without ``diameter`` or ``box``.
            SettingError: when a setting is unknown, missing, of another type or out of its range.
            ValueError: on an impossible layout.
        """
        diameter, box = arguments["diameter"], arguments["box"]
        settings = {name: value for name, value in arguments.items() if name not in ("diameter", "box")}
        return cls(read(NetworkSettings, settings), diameter, box)

    def cast_votes(
        self,
        points: Float[Tensor, "batch points 3"],
        normals: Float[Tensor, "batch points 3"],
        neighborhoods: Neighborhoods,
    ) -> Votes:
        """Seeds and their votes (section 3.1); offsets leave the network in units of half a diameter."""
        seed_xyz, seed_feature = self.backbone(points, normals, neighborhoods)
        residual = self.vote(seed_feature)
        # [b, m, 3 + c] -> [b, m, 3] and [b, m, c]
        offset, correction = residual[..., :3], residual[..., 3:]
        xyz = seed_xyz + offset * (0.5 * self.diameter)
        feature = seed_feature + correction
        rotation = None if self.vote_rotation is None else self._matrix(widened(self.vote_rotation(feature)))
        # [b, s of the first level] -> [b, m]: the seeds are a prefix of the farthest-point order
        return Votes(neighborhoods.order[:, : self.layout.seeds], xyz, feature, rotation)

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
        batch = len(peaks.center_seed)
        radius = self.voting_radius if self.training else self.test_voting_radius or self.voting_radius
        index = gather_votes(votes.xyz.detach(), peaks.center_seed, radius, self.gathered)
        # One table of all samples' votes: [b, k, h] indices within a sample -> [b * k, h] rows of [b * m, c]
        first_row = torch.arange(batch, device=index.device)[:, None, None] * votes.xyz.shape[1]
        index = (index + first_row).flatten(0, 1)
        # [b, k, 3] -> [b * k, 3]
        seed = peaks.center_seed.flatten(0, 1)
        if rows is not None:
            # [b * k, ...] -> [r, ...]
            index, seed = index[rows], seed[rows]
        # [b, m, 3] -> [b * m, 3] -> [r, h, 3], from the seeds [r, 1, 3]
        offsets = (votes.xyz.flatten(0, 1)[index] - seed[:, None]) / self.voting_radius
        # [b, m, c] -> [b * m, c]
        fused = self.fusion(offsets, votes.feature.flatten(0, 1), index)
        feature = self.head(fused)
        out = widened(self.output(feature))
        channels = self.channels
        # [r, channels] -> [r, 3]
        center = seed + out[:, channels.offset] * (0.1 * self.diameter)
        # [r, channels] -> [r, 4 or 6]
        raw = out[:, channels.rotation]
        rotation = self._matrix(raw)
        quaternion = unit_quaternion(raw) if self.rotation == "quaternion" else quaternion_from_matrix(rotation)
        # [r, channels] -> [r, classes] and [r]
        return Poses(center, rotation, quaternion, out[:, channels.class_logits], out[:, channels.score], feature)

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
        neighborhoods: Neighborhoods | None = None,
    ) -> Predictions:
        """Poses of all instances.

        Args:
            points: metres, camera frame, in random order.
            normals: unit, towards the camera.
            neighborhoods: of the points, when they were looked up before.
        """
        if neighborhoods is None:
            neighborhoods = find_batch(points, self.layout)
        votes = self.cast_votes(points, normals, neighborhoods)
        peaks = self.find_peaks(votes)
        poses = self.regress(votes, peaks)
        batch, k = peaks.heat.shape
        # [b] -> [b * k]: the sample of every row
        sample = torch.arange(batch, device=points.device).repeat_interleave(k)
        if len(self.refiners):
            poses = self.refine(points, normals, sample, poses)[-1]

        def shaped(rows: Tensor) -> Tensor:
            # [b * k, ...] -> [b, k, ...]
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
        # [b, k, 1, 3] - [b, 1, k, 3] -> [b, k, k]: row i of a sample asks whether proposal j stands in its place
        near = (center[:, :, None] - center[:, None]).square().sum(-1) < self.merge_radius**2
        index = torch.arange(center.shape[1], device=center.device)
        # [b, 1, k] against [b, k, 1] -> [b, k, k]
        ahead = (valid[:, None] > valid[:, :, None]) | (
            (valid[:, None] == valid[:, :, None]) & (index[None, :] < index[:, None])
        )
        return torch.where((near & ahead).any(-1), torch.zeros_like(confidence), confidence)

    def confidence_of(self, score: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows"]:
        """Confidence of a score: exp(s) with s clamped to +-8 (Eq. 10), or sigmoid(s)."""
        return torch.sigmoid(score) if self.confidence == "quality" else score.clamp(-8, 8).exp()

    def _matrix(self, raw: Tensor) -> Tensor:
        return matrix_from_quaternion(raw) if self.rotation == "quaternion" else matrix_from_six(raw)
