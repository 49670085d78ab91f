"""Answers of the network, stage by stage: votes, poses of proposals, and the outputs of the exported graph."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Votes(NamedTuple):
    """One vote a seed: where the centre of its instance is (section 3.1).

    Attributes:
        seed_index: ``(batch, M)`` index of the seed among the sample's points.
        xyz: ``(batch, M, 3)`` voted centre, metres.
        feature: ``(batch, M, F)``.
        rotation: ``(batch, M, 3, 3)`` rotation voted by the auxiliary head, None without one.
    """

    seed_index: Tensor
    xyz: Tensor
    feature: Tensor
    rotation: Tensor | None


class Poses(NamedTuple):
    """Poses of proposals, one row each.

    Attributes:
        center: ``(rows, 3)`` metres, the part's origin in the camera frame.
        rotation: ``(rows, 3, 3)`` ``camera_from_part``.
        quaternion: ``(rows, 4)`` unit quaternion with the sign the network gave it (Eq. 6 needs it).
        class_logits: ``(rows, classes)``.
        score: ``(rows,)`` logarithm of the confidence c (Eq. 10), or the logit of the expected quality.
        feature: ``(rows, width)``.
    """

    center: Tensor
    rotation: Tensor
    quaternion: Tensor
    class_logits: Tensor
    score: Tensor
    feature: Tensor


class Predictions(NamedTuple):
    """What the network answers; field names are the names of the exported graph's outputs.

    Attributes:
        vote_xyz: ``(batch, M, 3)`` voted centres.
        center_seed: ``(batch, K, 3)`` heatmap peaks, hottest first, or the farthest votes in their order.
        peak_heat: ``(batch, K)`` heat, 1 for a farthest vote; 0 where there are fewer than K peaks.
        center: ``(batch, K, 3)`` metres.
        quaternion: ``(batch, K, 4)`` unit, w first.
        class_logits: ``(batch, K, classes)``.
        confidence: ``(batch, K)``, higher is better; 0 for a proposal that was merged into another.
    """

    vote_xyz: Tensor
    center_seed: Tensor
    peak_heat: Tensor
    center: Tensor
    quaternion: Tensor
    class_logits: Tensor
    confidence: Tensor
