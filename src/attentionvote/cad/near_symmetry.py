"""Poses in which a part nearly looks like itself, and its mirror image: what a network is most likely to mix up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.rotation_check import RotationCheck
from attentionvote.geometry import pose
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import surface_moments

Array = NDArray[np.float64]

ALIKE = 0.01  # of the diameter: a point of the turned surface this near to the surface lies on it
LEAST_OVERLAP = 0.6  # share of such points from which a turn is worth listing
MOST_TWINS = 6
SAME_TURN = np.radians(20.0)  # nearer turns fall to one pose, or to the right one
STEP = np.radians(30.0)  # of the turns about the principal axes that are tried; registration finds the nearest fit


class Twin(NamedTuple):
    """A turn that is no symmetry but leaves most of the surface in place.

    Attributes:
        rotation: ``(3, 3)`` in the part frame, about the part's origin up to ``translation`` ``(3,)`` metres.
        translation: metres.
        overlap: share of the surface that lies within ``ALIKE`` of the diameter of itself.
        largest: largest distance of a point of the turned surface to the surface, metres, beyond the height of facets.
    """

    rotation: Array
    translation: Array
    overlap: float
    largest: float


def near_symmetries(vertices: Array, faces: NDArray[np.int64], symmetry: Symmetry, diameter: float) -> list[Twin]:
    """Turns that nearly leave the surface in place, the best first; one of each set that the symmetry makes equal.

    Args:
        vertices: ``(V, 3)`` metres, part frame.
        faces: ``(F, 3)`` closed surface.
        symmetry: the part's, in the same frame.
        diameter: metres.
    """
    check, centroid, axes = _about_the_centroid(vertices, faces, diameter)
    twins: list[Twin] = []
    for start in _turns(axes):
        turn, shift = check.registered(start)
        is_known = symmetry.angle(turn, np.eye(3)) < SAME_TURN
        if is_known or any(_same(symmetry, turn, twin.rotation) for twin in twins):
            continue
        twin = _twin(check, turn, shift, diameter)
        if twin.overlap >= LEAST_OVERLAP:
            twins.append(twin._replace(translation=centroid + shift - turn @ centroid))
    return sorted(twins, key=lambda twin: -twin.overlap)[:MOST_TWINS]


def mirror_image(vertices: Array, faces: NDArray[np.int64], diameter: float) -> Twin:
    """How the part's mirror image fits the part best: ``rotation`` has determinant -1.

    ``largest`` near 0: the part has a plane of symmetry, and a left one is a right one. Elsewhere the mirror image is
    another part; a large ``overlap`` tells that the network would take one for the other.

    Args:
        vertices: ``(V, 3)`` metres, part frame.
        faces: ``(F, 3)`` closed surface.
        diameter: metres.
    """
    check, centroid, axes = _about_the_centroid(vertices, faces, diameter)
    reflection = np.eye(3) - 2 * np.outer(axes[0], axes[0])
    mirrored = RotationCheck((vertices - centroid) @ reflection, faces[:, ::-1], check.tolerance)
    best: Twin | None = None
    for start in _turns(axes):
        turn, shift = check.registered(start, points=mirrored.screen)
        twin = _twin(check, turn @ reflection, shift, diameter)
        if best is None or (twin.overlap, -twin.largest) > (best.overlap, -best.largest):
            best = twin
    assert best is not None
    return best._replace(translation=centroid + best.translation - best.rotation @ centroid)


def _about_the_centroid(
    vertices: Array, faces: NDArray[np.int64], diameter: float
) -> tuple[RotationCheck, Array, Array]:
    """The check in coordinates about the centroid, the centroid ``(3,)`` and the principal axes, rows of ``(3, 3)``."""
    _, centroid, covariance = surface_moments(vertices, faces)
    return RotationCheck(vertices - centroid, faces, ALIKE * diameter), centroid, np.linalg.eigh(covariance)[1].T


def _turns(axes: Array) -> Array:
    """Turns ``(R, 3, 3)`` to start from: about each principal axis, and the turns that exchange the axes."""
    about = [pose.rotation_about(u, np.arange(1, 12) * STEP) for u in axes]
    diagonals = [pose.rotation_about(axes.T @ d, np.array([1, 2]) * 2 * np.pi / 3) for d in _DIAGONALS]
    swaps = [pose.rotation_about(axes.T @ d, np.array([np.pi])) for d in _EDGES]
    return np.concatenate([np.eye(3)[None], *about, *diagonals, *swaps])


_DIAGONALS = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]], dtype=float)
_EDGES = np.array([[1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1], [0, 1, -1]], dtype=float)


def _same(symmetry: Symmetry, a: Array, b: Array) -> bool:
    """Whether ``a`` is ``b`` up to the symmetry, before or after the turn, or its inverse."""
    pairs = ((a, b), (a.T, b.T), (a, b.T), (a.T, b))
    return any(bool(symmetry.angle(p, q) < SAME_TURN) for p, q in pairs)


def _twin(check: RotationCheck, rotation: Array, translation: Array, diameter: float) -> Twin:
    distance = check.distances(rotation, translation)
    overlap = float((distance < ALIKE * diameter).mean())
    return Twin(rotation, translation, overlap, check.excess(rotation, translation))
