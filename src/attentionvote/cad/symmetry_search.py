"""Search for symmetry axes where the principal frame does not name them, and exact finite groups."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.rotation_check import RotationCheck
from attentionvote.geometry.nearest_symmetry import exact_group
from attentionvote.geometry.pose import matrix_from_quaternion, quaternion_from_matrix, rotation_about

Array = NDArray[np.float64]

ORDERS = (2, 3, 5, 7)  # every finite group has an element of prime order; larger primes are not searched
CANDIDATES = 16  # refined per order
HOPELESS = 0.06  # of the radius: a mean distance that half a step of the lattice cannot explain
LARGEST_GROUP = 60  # the icosahedron's


def hemisphere(step: float) -> Array:
    """Unit vectors ``(N, 3)`` about ``step`` radians apart, one of each pair of opposites (Fibonacci lattice)."""
    count = int(2 * np.pi / step**2)
    k = np.arange(count) + 0.5
    z = 1 - k / count
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


def turns_about(axes: Array, angle: float) -> Array:
    """Rotations ``(N, 3, 3)`` by ``angle`` radians about unit ``axes`` ``(N, 3)``."""
    half = angle / 2
    quaternions = np.concatenate([np.full((len(axes), 1), np.cos(half)), np.sin(half) * axes], axis=1)
    return matrix_from_quaternion(quaternions)


def search_axes(check: RotationCheck, step: float = np.radians(4.0)) -> list[tuple[Array, int]]:
    """(axis, prime order) of rotations that leave the surface in place, wherever the axis points.

    Coarse lattice of directions, then a local refinement of the best minima, then the full check.
    """
    axes = hemisphere(step)
    symmetries: list[tuple[Array, int]] = []
    for order in ORDERS:
        angle = 2 * np.pi / order
        scores = check.means(turns_about(axes, angle))
        cosine = np.abs(axes @ axes.T)
        is_near = cosine > np.cos(1.6 * step)
        is_minimum = np.array([s <= scores[near].min() for s, near in zip(scores, is_near, strict=True)])
        best = np.flatnonzero(is_minimum)
        for i in best[np.argsort(scores[best])][:CANDIDATES]:
            if scores[i] > HOPELESS * check.radius:
                break
            axis = refine_axis(check, axes[i], angle)
            if any(n == order and abs(axis @ u) > np.cos(step / 2) for u, n in symmetries):
                continue
            if check.holds(rotation_about(axis, angle)[None]):
                symmetries.append((axis, order))
    return symmetries


def refine_axis(check: RotationCheck, axis: Array, angle: float) -> Array:
    """The unit axis near ``axis`` about which a turn by ``angle`` fits the surface best."""
    rotation, _ = check.registered(rotation_about(axis, angle))
    if check.facet_height:  # else the few points of a screen tell as much; a small bore may be all that tells the axis
        rotation, _ = check.registered(rotation, rounds=6, points=check.points)
    if abs(np.trace(rotation) - 1 - 2 * np.cos(angle)) > 0.2:  # fell into another symmetry
        return axis
    values, vectors = np.linalg.eig(rotation)
    refined = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    return np.asarray(refined * np.sign(refined @ axis) / np.linalg.norm(refined))


def closure(generators: Array) -> Array | None:
    """The finite group ``(G, 3, 3)`` that approximate ``generators`` ``(N, 3, 3)`` make, exact to rounding.

    Returns None when they make more than 60 elements, that is, none of the finite groups but large
    cyclic and dihedral ones, which the caller treats by their axis.
    """
    elements = [np.eye(3)]
    queue = list(generators)
    while queue:
        r = queue.pop()
        if min(np.linalg.norm(r - e) for e in elements) < 0.1:
            continue
        elements.append(r)
        if len(elements) > LARGEST_GROUP:
            return None
        queue += [r @ e for e in elements] + [e @ r for e in elements]
    return exact_group(np.stack(elements))


def quaternions_of(group: Array) -> list[tuple[float, ...]]:
    """The elements ``(G, 3, 3)`` as quaternions, 9 digits, identity first."""
    q = np.round(quaternion_from_matrix(group), 9) + 0.0
    return [tuple(float(v) for v in row) for row in q[np.argsort(-q[:, 0], kind="stable")]]
