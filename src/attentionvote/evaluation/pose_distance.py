"""The pose distance of Bregier et al. (2017), Eq. 12 of the paper, as the benchmark's toolbox computes it.

A pose has one or several *representatives*, points of a Euclidean space; the distance of two poses
is the least distance between their representatives. It is a length: the root mean square
displacement of the surface, minimised over the symmetries of the part.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from attentionvote.evaluation.scene_result import Array
from attentionvote.geometry.pose import transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part, surface_moments


@dataclass(frozen=True, eq=False)
class PoseMetric:
    """Distance between poses of one part, in metres.

    Representatives (shared/reference, section 2; Bregier et al. 2017, table 2):

    * finite group ``G``: ``vec(R G_k Lambda)`` and ``t``, one per element, 12 numbers;
    * revolution: ``lambda R axis`` and ``t``, with ``lambda^2 = lambda_r^2 + lambda_z^2``, 6 numbers;
    * revolution with flip: the same with both signs.

    The toolbox takes ``t`` at the origin of the part frame, not at the centroid of the surface; that
    is the default here. ``part_from_reference`` moves the reference (then ``symmetry`` and
    ``covariance_root`` are meant in the reference frame): the object-side form of the paper.

    Args:
        symmetry: proper symmetry of the part.
        covariance_root: Lambda ``(3, 3)`` in metres, matrix root of the surface covariance.
        part_from_reference: ``(4, 4)`` frame in which the poses are compared; identity by default.

    Raises:
        ValueError: with one sentence, when a matrix has the wrong shape or is not finite.
    """

    symmetry: Symmetry
    covariance_root: Array
    part_from_reference: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        for name, shape in (("covariance_root", (3, 3)), ("part_from_reference", (4, 4))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} must be {shape} finite numbers, got shape {value.shape}: {value.tolist()}")
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, part: Part, at_centroid: bool = False) -> PoseMetric:
        """The metric of a part; ``at_centroid`` compares positions of the surface centroid, not of the origin."""
        if not at_centroid:
            return cls(part.symmetry, part.covariance_root)
        centroid = surface_moments(part.vertices, part.faces)[1]
        return cls(part.symmetry, part.covariance_root, transform(np.eye(3), centroid))

    @property
    def revolution_radius(self) -> float:
        """``lambda`` in metres of a body of revolution: ``sqrt(lambda_r^2 + lambda_z^2)``."""
        covariance = self.covariance_root @ self.covariance_root.T
        axis = np.asarray(self.symmetry.axis)
        along = float(axis @ covariance @ axis)
        across = (float(np.trace(covariance)) - along) / 2
        return float(np.sqrt(along + across))

    def representatives(self, poses: ArrayLike) -> Array:
        """Representatives ``(P, K, 12 or 6)`` of poses ``(P, 4, 4)``, metres; the first is the identity's."""
        p = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4) @ self.part_from_reference
        r = p[:, None, :3, :3]
        if self.symmetry.is_revolution:
            axis = self.revolution_radius * np.asarray(self.symmetry.axis)
            shape = np.stack([axis, -axis][: 2 if self.symmetry.flip else 1])
            turned = (r @ shape[:, :, None])[..., 0]
        else:
            shape = self.symmetry.rotations() @ self.covariance_root
            turned = (r @ shape).reshape(len(p), len(shape), 9)
        position = np.broadcast_to(p[:, None, :3, 3], (*turned.shape[:2], 3))
        return np.concatenate([turned, position], axis=-1)

    def distances(self, a: ArrayLike, b: ArrayLike) -> Array:
        """Distances ``(A, B)`` in metres between poses ``(A, 4, 4)`` and ``(B, 4, 4)``.

        By group symmetry one representative of ``a`` against all of ``b`` is enough.
        """
        first = self.representatives(a)[:, 0]
        every = self.representatives(b)
        table = cdist(first, every.reshape(-1, first.shape[-1]))
        return table.reshape(len(first), *every.shape[:2]).min(-1)


def rotation_errors(a: ArrayLike, b: ArrayLike, symmetry: Symmetry) -> Array:
    """Angles ``(P,)`` in radians between paired poses ``(P, 4, 4)``, least over the symmetries.

    For a body of revolution: the angle between the axes (of at most 90 degrees with ``flip``).
    """
    r_a, r_b = (np.asarray(p, dtype=np.float64).reshape(-1, 4, 4)[:, :3, :3] for p in (a, b))
    return symmetry.angle(r_a, r_b)
