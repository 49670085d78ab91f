"""Proper symmetries of a part: which rotations leave its surface where it is.

Finite groups (none, cyclic, dihedral, or an explicit list such as a cube's) are enumerated;
a body of revolution has a continuum of them and is described by its axis and whether it may also be
turned over (``flip``). Mirror images are never symmetries of a rigid pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import matrix_from_quaternion, rotation_about, rotation_angle

Kind = Literal["none", "cyclic", "dihedral", "group", "revolution"]
Axis = tuple[float, float, float]
LARGEST_ORDER = 10_000  # of a body that is not one of revolution; more is a slip of the pen


@dataclass(frozen=True)
class Symmetry:
    """The proper symmetry of a part, in the part's own frame; all axes pass through its origin.

    Args:
        kind: ``none``; ``cyclic`` (``order`` turns about ``axis``); ``dihedral`` (the same, plus half
            turns about ``flip_axis`` and its images); ``group`` (every element listed in
            ``quaternions``, identity included); ``revolution`` (any turn about ``axis``).
        axis: unit axis of the cyclic, dihedral and revolution kinds.
        order: number of turns about ``axis`` for the cyclic and dihedral kinds.
        flip: whether a body of revolution may also be turned over.
        flip_axis: axis of one half turn of the dihedral kind, perpendicular to ``axis``.
        quaternions: the elements of a ``group``.

    Raises:
        ValueError: with one sentence, when the arguments describe no group.
    """

    kind: Kind = "none"
    axis: Axis = (0.0, 0.0, 1.0)
    order: int = 1
    flip: bool = False
    flip_axis: Axis = (1.0, 0.0, 0.0)
    quaternions: Sequence[Sequence[float]] = ()

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"symmetry kind must be one of {', '.join(get_args(Kind))}, got {self.kind!r}")
        for name in ("axis", "flip_axis"):
            raw = getattr(self, name)
            try:
                value = np.asarray(raw, dtype=np.float64)
            except (TypeError, ValueError):
                value = np.zeros(0)
            if value.shape != (3,) or not np.isfinite(value).all() or np.linalg.norm(value) < 1e-9:
                raise ValueError(
                    f"symmetry {name} must be three finite numbers, not all zero, as in [0, 0, 1]; got {raw!r}"
                )
            unit = value / np.linalg.norm(value)
            object.__setattr__(self, name, (float(unit[0]), float(unit[1]), float(unit[2])))
        is_number = isinstance(self.order, (int, float)) and not isinstance(self.order, bool)
        is_whole = is_number and np.isfinite(self.order) and self.order == int(self.order)
        if not is_whole or (self.kind in ("cyclic", "dihedral") and self.order < 2):
            raise ValueError(f"{self.kind} symmetry must have a whole order of at least 2, got {self.order!r}")
        if self.order > LARGEST_ORDER:
            raise ValueError(f"symmetry order must be at most {LARGEST_ORDER}, got {self.order!r}: is it a revolution?")
        if not isinstance(self.flip, bool):
            raise ValueError(f"symmetry flip must be true or false, got {self.flip!r}")
        if self.kind == "dihedral" and abs(np.dot(self.axis, self.flip_axis)) > 1e-6:
            raise ValueError(f"flip_axis must be perpendicular to axis, got {self.flip_axis} and {self.axis}")
        try:
            object.__setattr__(self, "quaternions", tuple(tuple(float(v) for v in q) for q in self.quaternions))
        except (TypeError, ValueError) as error:
            raise ValueError(
                "a group must list its elements as quaternions of four numbers (w, x, y, z), "
                f"got {self.quaternions!r:.80}"
            ) from error
        if self.kind == "group":
            self._check_group()

    def _check_group(self) -> None:
        if not self.quaternions or any(len(q) != 4 for q in self.quaternions):
            raise ValueError("a group must list its elements as quaternions of four numbers (w, x, y, z)")
        lengths = np.linalg.norm(self.quaternions, axis=1)
        if not np.isfinite(lengths).all() or lengths.min() < 1e-9:
            raise ValueError("each quaternion of a group must have finite numbers, not all zero")
        r = matrix_from_quaternion(self.quaternions)
        apart = np.abs(r[:, None] - r).max((-2, -1)) + np.eye(len(r))
        if apart.min() < 1e-5:
            raise ValueError("a group must list each rotation once (q and -q are the same rotation)")
        products = np.einsum("aij,bjk->abik", r, r).reshape(-1, 9)
        nearest = np.abs(products[:, None] - r.reshape(1, -1, 9)).max(-1).min(-1)
        if nearest.max() > 1e-5:
            raise ValueError("the product of two listed rotations must be listed too, or they form no group")

    @property
    def is_revolution(self) -> bool:
        """Whether there is a continuum of symmetries."""
        return self.kind == "revolution"

    def rotations(self) -> NDArray[np.float64]:
        """The elements ``(G, 3, 3)`` of the finite part of the group, identity first.

        For a body of revolution: the identity and, with ``flip``, one half turn about a
        perpendicular axis; the turns about ``axis`` are not enumerated.
        """
        if self.kind == "none":
            return np.eye(3)[None]
        if self.kind == "group":
            r = matrix_from_quaternion(self.quaternions)
            return r[np.argsort(np.abs(r - np.eye(3)).max((-2, -1)) > 1e-6, kind="stable")]
        if self.kind == "revolution":
            return np.stack([np.eye(3), rotation_about(self.perpendicular, np.pi)]) if self.flip else np.eye(3)[None]
        turns = rotation_about(self.axis, 2 * np.pi * np.arange(self.order) / self.order)
        if self.kind == "cyclic":
            return turns
        return np.concatenate([turns, turns @ rotation_about(self.flip_axis, np.pi)])

    @property
    def perpendicular(self) -> Axis:
        """A unit axis perpendicular to ``axis``."""
        a = np.asarray(self.axis)
        other = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        other /= np.linalg.norm(other)
        return float(other[0]), float(other[1]), float(other[2])

    def frame(self) -> NDArray[np.float64]:
        """Rotation ``(3, 3)`` whose third column is ``axis``: ``part_from_axis``, z along the axis."""
        x = np.asarray(self.perpendicular)
        z = np.asarray(self.axis)
        return np.stack([x, np.cross(z, x), z], axis=-1)

    def angle(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Angles ``(...)`` in radians between rotations ``(..., 3, 3)``, least over the symmetries.

        For a body of revolution: the angle between the axes (of at most 90 degrees with ``flip``).
        """
        if not self.is_revolution:
            return np.asarray(rotation_angle(a[..., None, :, :], b[..., None, :, :] @ self.rotations()).min(-1))
        axis = np.asarray(self.axis)
        # The half-chord form is accurate near zero, where arccos is not.
        chord = np.linalg.norm(a @ axis - b @ axis, axis=-1)
        angle = 2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0))
        return np.asarray(np.minimum(angle, np.pi - angle) if self.flip else angle)
