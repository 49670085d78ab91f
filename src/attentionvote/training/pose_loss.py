"""Rotation and pose errors that know a part's symmetry, as differentiable torch (paper section 3.4).

Four rotation losses: the paper's ``slerp`` (Eq. 6), ``minra`` (Eq. 7) and ``nlerp`` on quaternions, and ``metric``,
the rotational part of the pose distance of the evaluation (Bregier et al. 2017). That one is the alternative to the
paper's: it compares rotation matrices, so that there is no sign to choose (q and -q are one matrix, and Eq. 6 needs one
of them as the label, Eq. 7 leaves it open), and symmetry is the same minimum over the group for every class. For a body
of revolution all quaternion forms become the angle between the axes (Eq. 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from attentionvote.geometry import pose
from attentionvote.geometry.pose import canonical_quaternion
from attentionvote.model.constants import Constant
from attentionvote.model.precision import full_precision
from attentionvote.model.rotation import quaternion_from_matrix
from attentionvote.part import Part
from attentionvote.training.settings import RotationLoss

_TINY = 1e-6


@dataclass(frozen=True)
class SymmetricPose:
    """What the losses need of a part.

    Args:
        diameter: D in metres.
        group: ``(G, 3, 3)`` finite part of the symmetry group.
        representation: ``(3, c)`` metres; two rotations differ by ``|(R1 - R2 g) representation|``, minimum over g:
            Lambda for a finite group, lambda times the axis for a body of revolution.
        axis: ``(3,)`` of a body of revolution, None otherwise.

    Tables are kept in double precision; every loss is computed in that of the predictions.
    """

    diameter: float
    group: Tensor
    representation: Tensor
    axis: Tensor | None

    @classmethod
    def of(cls, part: Part, isotropic: float = 0.0) -> SymmetricPose:
        """The part's, with ``isotropic`` x D added to Lambda: weight for turns that hardly move the surface."""
        root = part.covariance_root + isotropic * part.diameter * np.eye(3)
        axis = None
        if part.symmetry.is_revolution:
            direction = np.asarray(part.symmetry.axis)
            along = np.linalg.norm(part.covariance_root @ direction)
            across = np.sqrt(max(np.trace(part.covariance_root @ part.covariance_root) - along**2, 0.0) / 2)
            root = (np.hypot(along, across) * direction)[:, None]
            axis = torch.tensor(direction, dtype=torch.float64)
        group = torch.tensor(part.symmetry.rotations(), dtype=torch.float64)
        return cls(part.diameter, group, torch.tensor(root, dtype=torch.float64), axis)

    def like(self, values: Tensor) -> SymmetricPose:
        """The same on the device and in the precision of ``values``."""
        group, representation, *axis = (table.like(values) for table in self._constants)
        return SymmetricPose(self.diameter, group, representation, axis[0] if axis else None)

    @cached_property
    def _constants(self) -> list[Constant]:
        return [Constant(table) for table in (self.group, self.representation, self.axis) if table is not None]

    def squared_turn(
        self, predicted: Float[Tensor, "rows 3 3"], true: Float[Tensor, "rows 3 3"]
    ) -> Float[Tensor, " rows"]:
        """Square of the rotational distance in square metres, minimum over the symmetry group."""
        with full_precision(true.device):
            tables = self.like(predicted)
            # [r, 1, 3, 3] @ [g, 3, columns] -> [r, g, 3, columns]
            aims = true[:, None] @ (tables.group @ tables.representation)
            return (predicted[:, None] @ tables.representation - aims).square().sum((-2, -1)).amin(1)

    def distance(
        self,
        center: Float[Tensor, "rows 3"],
        rotation: Float[Tensor, "rows 3 3"],
        true_center: Float[Tensor, "rows 3"],
        true_rotation: Float[Tensor, "rows 3 3"],
    ) -> Float[Tensor, " rows"]:
        """The pose distance of the evaluation in metres (with ``isotropic`` 0)."""
        return (self.squared_turn(rotation, true_rotation) + (center - true_center).square().sum(-1)).sqrt()

    def rotation_loss(
        self,
        kind: RotationLoss,
        quaternion: Float[Tensor, "rows 4"],
        rotation: Float[Tensor, "rows 3 3"],
        true: Float[Tensor, "rows 3 3"],
    ) -> Float[Tensor, " rows"]:
        """Rotation loss of each row: ``metric`` in units of 0.1 D, the quaternion forms in radians.

        Raises:
            ValueError: on an unknown ``kind``.
        """
        if kind == "metric":
            return metric_loss(self.squared_turn(rotation, true), self.diameter)
        if kind not in get_args(RotationLoss):
            raise ValueError(f"rotation loss must be one of {', '.join(get_args(RotationLoss))}, got {kind!r}")
        tables = self.like(rotation)
        if tables.axis is not None:
            with full_precision(true.device):
                aims = torch.einsum("rij,gjk,k->rgi", true, tables.group, tables.axis)
                # [r, 3, 3] @ [3] -> [r, 1, 3], against [r, g, 3]
                axes = (rotation @ tables.axis)[:, None]
                return angle_between(axes, aims).amin(1)
        return quaternion_loss(kind, quaternion[:, None], self._equivalents(true)).amin(1)

    def _equivalents(self, true: Tensor) -> Tensor:
        """Canonical quaternions ``(rows, G, 4)`` of the equivalent rotations: here, and only here, the sign that
        Eq. (6) depends on becomes part of the label."""
        if true.device.type not in ("cpu", "mps"):  # a GPU is not to wait for a copy; mps knows no double precision
            return equivalent_quaternions(true, self._constants[0].on(true.device, torch.float64))
        # [r, 1, 3, 3] @ [g, 3, 3] -> [r, g, 3, 3]
        matrices = true[:, None].detach().cpu().numpy() @ self.group.cpu().numpy()
        quaternions = canonical_quaternion(pose.quaternion_from_matrix(matrices))
        return torch.from_numpy(quaternions).to(true.dtype).to(true.device)


def equivalent_quaternions(true: Float[Tensor, "rows 3 3"], group: Float[Tensor, "g 3 3"]) -> Float[Tensor, "rows g 4"]:
    """Canonical quaternions of the rotations ``true @ group``, in double precision on the device of ``true``."""
    with full_precision(true.device):
        # [r, 1, 3, 3] @ [g, 3, 3] -> [r, g, 3, 3]
        q = quaternion_from_matrix(true.detach().double()[:, None] @ group)
    sign = torch.ones_like(q[..., 0])
    for component in reversed(q.unbind(-1)):  # that of the first one that is not zero, as ``canonical_quaternion``
        sign = torch.where(component.abs() > 1e-12, component.sign(), sign)
    return (q * sign[..., None]).to(true.dtype)


def metric_loss(
    squared_turn: Float[Tensor, " rows"], diameter: Float[Tensor, " rows"] | float
) -> Float[Tensor, " rows"]:
    """Rotational distances in units of 0.1 D, with a bounded gradient where there is none."""
    return (squared_turn + (_TINY * diameter) ** 2).sqrt() / (0.1 * diameter)


def quaternion_loss(
    kind: RotationLoss, predicted: Float[Tensor, "*#rows 4"], true: Float[Tensor, "*#rows 4"]
) -> Float[Tensor, "*rows"]:
    """Eq. (6) ``slerp``, Eq. (7) ``minra`` or |q - q'| ``nlerp`` of unit quaternions.

    The angle is 4 atan2(|q - q'|, |q + q'|), which equals 2 arccos(q . q') but has a bounded gradient where the two
    agree, where that of arccos is infinite.
    """
    apart = ((predicted - true).square().sum(-1) + _TINY**2).sqrt()
    opposite = ((predicted + true).square().sum(-1) + _TINY**2).sqrt()
    if kind == "nlerp":
        return apart
    if kind == "minra":
        apart, opposite = torch.minimum(apart, opposite), torch.maximum(apart, opposite)
    return 4.0 * torch.atan2(apart, opposite)


def angle_between(a: Float[Tensor, "*#rows 3"], b: Float[Tensor, "*#rows 3"]) -> Float[Tensor, "*rows"]:
    """Angle in radians between unit vectors (Eq. 8), with a bounded gradient everywhere."""
    apart = ((a - b).square().sum(-1) + _TINY**2).sqrt()
    together = ((a + b).square().sum(-1) + _TINY**2).sqrt()
    return 2.0 * torch.atan2(apart, together)
