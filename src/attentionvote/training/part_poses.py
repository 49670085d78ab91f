"""Rotation and pose errors of rows that belong to different parts: each by the symmetry and the size of its own.

The rotational distance of every part becomes one padded table, so that a mixed batch needs no loop over the parts:
equivalents of a part with fewer are repeated, which leaves the minimum alone, and the single column that a body of
revolution needs is filled up with zeros, which adds nothing to the sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from attentionvote.model.constants import Constant
from attentionvote.model.precision import full_precision
from attentionvote.part import Parts
from attentionvote.training.pose_loss import RotationLoss, SymmetricPose, metric_loss


@dataclass(frozen=True)
class PartPoses:
    """``SymmetricPose`` of every part of a set; ``part`` names the part of each row, and nothing when there is one."""

    each: tuple[SymmetricPose, ...]

    @classmethod
    def of(cls, part: Parts, isotropic: float = 0.0) -> PartPoses:
        """Those of a part or a set of parts, see ``SymmetricPose.of``."""
        return cls(tuple(SymmetricPose.of(member, isotropic) for member in part.parts))

    def diameter(self, part: Int[Tensor, "*rows"], dtype: torch.dtype) -> Float[Tensor, "*rows"] | float:
        """D in metres of every row's part, in the precision of ``dtype``; one number where all are the same."""
        if len(self.each) == 1:
            return self.each[0].diameter
        return self._diameters.on(part.device, dtype)[part]

    def squared_turn(
        self, part: Int[Tensor, " rows"], predicted: Float[Tensor, "rows 3 3"], true: Float[Tensor, "rows 3 3"]
    ) -> Float[Tensor, " rows"]:
        """As ``SymmetricPose.squared_turn``, by each row's own part."""
        if len(self.each) == 1:
            return self.each[0].squared_turn(predicted, true)
        # [parts, ...] -> [r, ...]
        representation, equivalents = (table.like(predicted)[part] for table in self._tables)
        with full_precision(true.device):
            # [r, 1, 3, 3] @ [r, g, 3, 3] -> [r, g, 3, 3]
            aims = true[:, None] @ equivalents
            # [r, 3, 3] -> [r, 1, 3, 3]
            now = (predicted @ representation)[:, None]
            return (now - aims).square().sum((-2, -1)).amin(1)

    def distance(
        self,
        part: Int[Tensor, " rows"],
        center: Float[Tensor, "rows 3"],
        rotation: Float[Tensor, "rows 3 3"],
        true_center: Float[Tensor, "rows 3"],
        true_rotation: Float[Tensor, "rows 3 3"],
    ) -> Float[Tensor, " rows"]:
        """The pose distance of the evaluation in metres (with ``isotropic`` 0), by each row's own part."""
        return (self.squared_turn(part, rotation, true_rotation) + (center - true_center).square().sum(-1)).sqrt()

    def rotation_loss(
        self,
        kind: RotationLoss,
        part: Int[Tensor, " rows"],
        quaternion: Float[Tensor, "rows 4"],
        rotation: Float[Tensor, "rows 3 3"],
        true: Float[Tensor, "rows 3 3"],
    ) -> Float[Tensor, " rows"]:
        """As ``SymmetricPose.rotation_loss``, by each row's own part.

        Raises:
            ValueError: on an unknown ``kind``.
        """
        if kind == "metric":
            return metric_loss(self.squared_turn(part, rotation, true), self.diameter(part, rotation.dtype))
        if len(self.each) == 1:
            return self.each[0].rotation_loss(kind, quaternion, rotation, true)
        # Every row by every part, of which one counts: to look for a part's rows would have a GPU wait.
        loss = rotation.new_zeros(len(part))
        for index, pose in enumerate(self.each):
            loss = torch.where(part == index, pose.rotation_loss(kind, quaternion, rotation, true), loss)
        return loss

    @cached_property
    def _diameters(self) -> Constant:
        return Constant(torch.tensor([pose.diameter for pose in self.each], dtype=torch.float64))

    @cached_property
    def _tables(self) -> tuple[Constant, Constant]:
        """Representations ``(parts, 3, 3)`` and their equivalents ``(parts, most, 3, 3)``, metres."""
        most = max(len(pose.group) for pose in self.each)
        representations, equivalents = [], []
        for pose in self.each:
            representation = torch.zeros(3, 3, dtype=torch.float64)
            representation[:, : pose.representation.shape[1]] = pose.representation
            turned = pose.group @ representation
            representations.append(representation)
            equivalents.append(turned[torch.arange(most) % len(turned)])
        return Constant(torch.stack(representations)), Constant(torch.stack(equivalents))
