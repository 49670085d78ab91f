"""The group of rotations about one point that a BOP model's symmetries are, or are nearly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.nearest_symmetry import TOLERANCE, nearest_elements, nearest_symmetry
from attentionvote.geometry.pose import quaternion_from_matrix, rotation_about, rotation_angle
from attentionvote.geometry.symmetry import Symmetry

Array = NDArray[np.float64]
Axes = Sequence[tuple[Array, Array]]
# Axes of revolution this far apart are meant: any two are those of a ball.
BALL_AXES = np.radians(30.0)
# What six digits leave, radians and share of the diameter: less is not worth a word.
EXACT_ANGLE, EXACT_SHARE = 1e-5, 1e-4


class NearestGroup(NamedTuple):
    """A group and how far the file's symmetries are off.

    Attributes:
        symmetry: rotations about ``center``; None for all rotations, a ball's.
        center: ``(3,)`` millimetres, nearest to the origin where there are several.
        angle: radians, the largest between a listed rotation or axis and that of the group.
        distance: millimetres, the largest by which an axis misses ``center`` or a listed symmetry moves it.
        missing: rotations of a finite group, but for the identity, that the file does not list.
    """

    symmetry: Symmetry | None
    center: Array
    angle: float
    distance: float
    missing: int

    def remarks(self, diameter: float) -> list[str]:
        """What is worth a word, the end of a sentence each: more than rounding, and rotations that are not listed."""
        remarks = []
        if self.angle > EXACT_ANGLE or self.distance > EXACT_SHARE * diameter:
            remarks.append(f"off by up to {np.degrees(self.angle):.2g} degrees and {round(self.distance, 4):.2g} mm")
        if self.missing:
            remarks.append(f"listed without {self.missing} of their products")
        return remarks

    @property
    def described(self) -> str:
        """The group in words."""
        if self.symmetry is None:
            return "all rotations"
        if self.symmetry.is_revolution:
            return "all turns about an axis" + (" and half turns across it" if self.symmetry.flip else "")
        return f"the {len(self.symmetry.rotations())} rotations of the nearest group"


def nearest_group(where: str, discrete: Array, continuous: Axes, diameter: float) -> NearestGroup:
    """The group that symmetries ``(K, 4, 4)`` and axes with a point on each generate, within 3 degrees.

    Args:
        where: beginning of a sentence about the model.
        discrete, continuous, diameter: millimetres; the matrices are rotations but for rounding.

    Raises:
        ValueError: with one sentence, when they are those of no group, or their axes meet in no point.
    """
    u, _, vt = np.linalg.svd(discrete[:, :3, :3])
    turns = np.asarray(u @ vt)
    directions = [axis / np.linalg.norm(axis) for axis, _ in continuous]
    symmetry: Symmetry | None
    missing = 0
    if continuous:
        symmetry, exact, angle = _revolution(where, turns, directions)
    elif (nearest := nearest_symmetry(turns)) is not None:
        symmetry, angle = nearest
        group = symmetry.rotations()
        index = nearest_elements(group, turns)
        exact, missing = group[index], len(group) - len({0, *index.tolist()})
    else:
        raise ValueError(
            f"{where} must have symmetries_discrete within {np.degrees(TOLERANCE):.0f} degrees of a group of "
            f"rotations, all but the identity, got {len(turns)} that are near none"
        )
    # What a symmetry (R, t) leaves where it is: (I - R) c = t; an axis u through o: (I - u u^T) (c - o) = 0.
    across = [np.eye(3) - np.outer(direction, direction) for direction in directions]
    rows = np.concatenate([np.eye(3) - exact, np.array(across).reshape(-1, 3, 3)])
    aims = np.concatenate(
        [discrete[:, :3, 3], np.array([p @ o for p, (_, o) in zip(across, continuous, strict=True)]).reshape(-1, 3)]
    )
    center = np.linalg.lstsq(rows.reshape(-1, 3), aims.ravel(), rcond=1e-9)[0] if len(rows) else np.zeros(3)
    distance = float(np.linalg.norm(rows @ center - aims, axis=1).max(initial=0.0))
    if distance > TOLERANCE * (diameter + float(np.linalg.norm(center))):
        raise ValueError(
            f"{where} must have symmetries that leave one point where it is, got axes that miss each other, or "
            f"translations along them, by {distance:.3g} mm"
        )
    return NearestGroup(symmetry, center, angle, distance, missing)


def _revolution(where: str, turns: Array, directions: list[Array]) -> tuple[Symmetry | None, Array, float]:
    """The symmetry of a body of revolution, the exact ``turns`` ``(K, 3, 3)``, and the largest angle off in radians."""
    axis = directions[0]
    between = np.array([_between(axis, direction) for direction in directions])
    if between.max() > BALL_AXES:
        return None, turns, 0.0
    if between.max() > TOLERANCE:
        raise ValueError(
            f"{where} must have axes of revolution within {np.degrees(TOLERANCE):.0f} degrees of one, or, for a ball, "
            f"at least {np.degrees(BALL_AXES):.0f} apart, got {np.degrees(between.max()):.1f}"
        )
    tilt = np.array([_between(axis, turn @ axis) for turn in turns])
    if tilt.max(initial=0.0) > TOLERANCE:
        raise ValueError(
            f"{where} must have symmetries_discrete that leave its axis of revolution where it is or turn it over, "
            f"within {np.degrees(TOLERANCE):.0f} degrees, got one that turns it by {np.degrees(tilt.max()):.1f}"
        )
    flips = turns @ axis @ axis < 0
    q = quaternion_from_matrix(turns)
    exact = np.empty_like(turns)
    for i, (w, *vector) in enumerate(q):
        along = float(np.dot(vector, axis))
        exact[i] = (
            rotation_about(np.asarray(vector) - along * axis, np.pi) if flips[i]
            else rotation_about(axis, 2 * np.arctan2(along, w))
        )  # fmt: skip
    off = max(float(rotation_angle(exact, turns).max(initial=0.0)), float(between.max()))
    x, y, z = (np.round(axis, 12) + 0.0).tolist()
    return Symmetry("revolution", (x, y, z), flip=bool(flips.any())), exact, off


def _between(a: Array, b: Array) -> float:
    """Angle in radians between two lines."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(np.dot(a, b))))
