"""Symmetry groups as the detection needs them: which rotations to check, which tell the centre, and in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import pose
from attentionvote.geometry.symmetry import Symmetry

Array = NDArray[np.float64]

# Turns by multiples of the golden angle: no small part of a full turn, so no finite group contains them.
REVOLUTION_ANGLES = np.mod(2 * np.pi * np.arange(1, 17) * (5**0.5 - 1) / 2, 2 * np.pi)


def tested_rotations(symmetry: Symmetry) -> Array:
    """The rotations ``(R, 3, 3)`` that are checked for ``symmetry``: all of a finite group but the identity,
    16 incommensurable turns of a body of revolution and their products with the flip."""
    finite = symmetry.rotations()
    if not symmetry.is_revolution:
        return finite[1:]
    turns = pose.rotation_about(symmetry.axis, REVOLUTION_ANGLES)
    return np.concatenate([turns @ r for r in finite])


def generators(symmetry: Symmetry) -> Array:
    """A few rotations ``(R, 3, 3)`` whose fixed points the whole group shares."""
    if symmetry.is_revolution:
        turns = pose.rotation_about(symmetry.axis, np.array([np.pi / 2, np.pi]))
        return np.concatenate([turns, symmetry.rotations()[1:]])
    rotations = symmetry.rotations()[1:]
    far = rotations[np.argsort(np.trace(rotations, axis1=1, axis2=2))]  # small turns tell little of their centre
    if symmetry.kind == "cyclic":
        return far[:2]
    # Half turns about different axes, which all groups with several axes have, and the turns between them.
    return np.concatenate([far[:3], far[-1:]])


def group_size(symmetry: Symmetry) -> float:
    """Number of rotations of the group; of a body of revolution more than of any finite group, with flip the double."""
    return len(symmetry.rotations()) * (1e6 if symmetry.is_revolution else 1.0)


def describe(symmetry: Symmetry) -> str:
    """The group in one phrase for people."""
    axis = "(" + " ".join(f"{round(v, 3) + 0.0:g}" for v in symmetry.axis) + ")"
    if symmetry.kind == "cyclic":
        return f"cyclic of order {symmetry.order} about {axis}"
    if symmetry.kind == "dihedral":
        return f"dihedral of order {symmetry.order} about {axis}"
    if symmetry.kind == "revolution":
        return f"revolution about {axis} {'with' if symmetry.flip else 'without'} flip"
    return "none" if symmetry.kind == "none" else f"group of {len(symmetry.quaternions)} rotations"
