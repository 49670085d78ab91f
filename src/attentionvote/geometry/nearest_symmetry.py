"""The symmetry group nearest to a list of rotations that is rounded, measured by hand, or incomplete.

Finite groups of rotations are cyclic, dihedral, or those of the tetrahedron, the cube and the icosahedron. The list is
taken for a whole group first (all rotations but the identity), which is decided at any order and with errors of almost
half a step; only if that fails, for generators of a group, of which a few precise rotations, or coarse ones of a small
group, are enough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import quaternion_from_matrix, rotation_about, rotation_angle
from attentionvote.geometry.symmetry import Symmetry

Array = NDArray[np.float64]

# Radians; hand-made lists were found 1.5 degrees off (LINEMOD's eggbox).
TOLERANCE = np.radians(3.0)
# Share of the smallest turn of a group: with larger errors two of its rotations could be mixed up.
LARGEST_SHARE = 0.49
SAME = 1e-3  # radians within which two listed rotations are one
POLYHEDRAL = (12, 24, 60)
# Products nearer than this (radians) are one rotation while generators are multiplied: precise ones, then coarse ones.
PRECISE, COARSE = np.radians((0.06, 0.3)), np.radians((3.0, 8.0, 16.0, 25.0))
FEW_STEPS = 2  # of the smallest turn of a group, within which two of its generators, or one and the identity, must be
MOST_GENERATED = 360  # a list of a whole group may be longer


def nearest_symmetry(rotations: Array, tolerance: float = TOLERANCE) -> tuple[Symmetry, float] | None:
    """The group of ``rotations`` ``(K, 3, 3)`` and the largest angle in radians that one of them is off.

    Repetitions and the identity may be listed. None when no group has a rotation within ``tolerance`` of each, another
    one for each.
    """
    listed = _distinct(rotations)
    if not len(listed):
        return Symmetry(), 0.0
    is_identity = rotation_angle(listed, np.eye(3)) < tolerance
    attempts = [listed, listed[~is_identity]] if is_identity.any() and not is_identity.all() else [listed]
    for some in attempts:
        if whole := _fit(_fitted(np.concatenate([np.eye(3)[None], some])), some, tolerance):
            return whole
    some = attempts[-1]
    for apart in PRECISE:
        if precise := _generated_fit(some, apart, tolerance):
            return precise
    coarse = [_generated_fit(some, apart, tolerance) for apart in COARSE]
    return min((fit for fit in coarse if fit), key=lambda fit: len(fit[0].rotations()), default=None)


def nearest_elements(group: Array, rotations: Array) -> NDArray[np.int64]:
    """Index ``(K,)`` in ``group`` ``(G, 3, 3)`` of the element nearest to each of ``rotations`` ``(K, 3, 3)``."""
    return np.asarray((rotations.reshape(-1, 9) @ group.reshape(-1, 9).T).argmax(1))


def exact_group(elements: Array, rounds: int = 6) -> Array:
    """Remove the rounding from an approximate group ``(G, 3, 3)``.

    Each element becomes the mean of all the products that should equal it; this converges quadratically
    to a true group (Grove, Karcher and Ruh 1974).
    """
    group = elements
    products = np.einsum("aji,bjk->abik", group, group)  # inverse(a) @ b
    table = np.linalg.norm(products[:, :, None] - group[None, None], axis=(-2, -1)).argmin(-1)
    for _ in range(rounds):
        # g[table[a, b]] should equal inverse(g[a]) @ g[b].
        mean = np.zeros_like(group)
        np.add.at(mean, table, np.einsum("aji,bjk->abik", group, group))
        left, _, right = np.linalg.svd(mean)
        group = left @ right
    return _snapped(group)


def _snapped(group: Array) -> Array:
    """The group with its numbers exact when it is a cube's or a tetrahedron's in line with the axes."""
    rounded = np.round(group)
    is_close = np.abs(group - rounded).max() < 2e-3
    return rounded if is_close else group


def _distinct(rotations: Array) -> Array:
    """The rotations without repetitions and without the identity."""
    distinct = np.empty((len(rotations) + 1, 3, 3))
    distinct[0], count = np.eye(3), 1
    for rotation in rotations:
        nearest = nearest_elements(distinct[:count], rotation[None])[0]
        if rotation_angle(distinct[nearest], rotation) > SAME:
            distinct[count] = rotation
            count += 1
    return distinct[1:count]


def _fit(symmetry: Symmetry | None, listed: Array, tolerance: float) -> tuple[Symmetry, float] | None:
    """The symmetry with the largest angle that a listed rotation is off, None when they do not fit one to one."""
    if symmetry is None:
        return None
    group = symmetry.rotations()
    index = nearest_elements(group, listed)
    off = float(rotation_angle(group[index], listed).max())
    step = float(rotation_angle(group[1:], np.eye(3)).min(initial=np.pi))
    is_one_to_one = len(set(index.tolist()) | {0}) == len(listed) + 1
    return (symmetry, off) if is_one_to_one and off <= min(tolerance, LARGEST_SHARE * step) else None


def _generated_fit(generators: Array, apart: float, tolerance: float) -> tuple[Symmetry, float] | None:
    """As ``_fit`` for what ``generators`` make; any angle is some steps of some group, so two of them must be near."""
    if (fit := _fit(_fitted(_generated(generators, apart)), generators, tolerance)) is None:
        return None
    step = float(rotation_angle(fit[0].rotations()[1:], np.eye(3)).min())
    those = np.concatenate([np.eye(3)[None], generators])
    apart_by = rotation_angle(those[:, None], those) + 2 * np.pi * np.eye(len(those))
    return fit if apart_by.min() < FEW_STEPS * step + tolerance else None


def _fitted(elements: Array | None) -> Symmetry | None:
    """The group that ``elements`` ``(G, 3, 3)``, the identity first, are all of; how well they fit is not judged."""
    if elements is None or len(elements) < 2:
        return None
    symmetry = _about_an_axis(elements)
    if symmetry is not None or len(elements) not in POLYHEDRAL:
        return symmetry
    group = exact_group(elements)
    turn = _alignment(group, elements)
    try:
        return Symmetry("group", quaternions=quaternion_from_matrix(_snapped(turn @ group @ turn.T)).tolist())
    except ValueError:
        return None


def _about_an_axis(elements: Array) -> Symmetry | None:
    """The cyclic or dihedral group of as many elements."""
    q = quaternion_from_matrix(elements)
    # Only turns that are no half turns tell the axis of a dihedral group.
    spread, directions = np.linalg.eigh((q[:, 1:] * q[:, :1] ** 2).T @ q[:, 1:])
    axis = directions[:, -1] if spread[-1] > 0.05 else q[1, 1:] / np.linalg.norm(q[1, 1:])
    along = elements @ axis @ axis
    turns, flips = np.flatnonzero(along > 0.8), np.flatnonzero(along < -0.8)
    order = len(turns)
    if len(turns) + len(flips) < len(elements) or len(flips) not in (0, order) or order < 2:
        return None
    exact = np.empty_like(elements)
    exact[0] = np.eye(3)
    angle = 2 * np.arctan2(q[turns[1:], 1:] @ axis, q[turns[1:], 0]) % (2 * np.pi)
    exact[turns[1:]] = rotation_about(axis, 2 * np.pi * (1 + _rank(angle)) / order)
    across = Symmetry("revolution", tuple(axis)).frame()[:, :2]
    flip = across[:, 0]
    if len(flips):
        # Twice the direction of a half turn's axis: whole turns apart by 1 / order.
        double = 2 * np.arctan2(*(q[flips, 1:] @ across).T[::-1]) % (2 * np.pi)
        step = 2 * np.pi * _rank(double) / order
        first = float(np.angle(np.exp(1j * (double - step)).mean()))
        directions = across @ np.stack([np.cos((first + step) / 2), np.sin((first + step) / 2)])
        exact[flips] = 2 * directions.T[:, :, None] * directions.T[:, None, :] - np.eye(3)
        flip = across @ (np.cos(first / 2), np.sin(first / 2))
    turn = _alignment(exact, elements)
    axis, flip = turn @ axis, turn @ flip
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    return Symmetry("dihedral" if len(flips) else "cyclic", _tidy(axis), order, flip_axis=_tidy(flip))


def _rank(values: Array) -> NDArray[np.int64]:
    return np.argsort(np.argsort(values))


def _tidy(direction: Array) -> tuple[float, float, float]:
    x, y, z = (np.round(direction, 12) + 0.0).tolist()
    return x, y, z


def _alignment(exact: Array, elements: Array) -> Array:
    """The small turn Q ``(3, 3)`` that brings ``Q exact Q^T`` nearest to ``elements`` ``(G, 3, 3)``."""
    skew = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]])  # fmt: skip  # noqa: E501
    turn = np.eye(3)
    for _ in range(3):
        turned = turn @ exact @ turn.T
        change = (skew[:, None] @ turned - turned @ skew[:, None]).reshape(3, -1)
        step = np.linalg.lstsq(change.T, (elements - turned).ravel(), rcond=1e-9)[0]
        if (length := float(np.linalg.norm(step))) < 1e-14:
            break
        turn = rotation_about(step, length) @ turn
    return turn


def _generated(generators: Array, apart: float) -> Array | None:
    """All products ``(G, 3, 3)``, the identity first, those within ``apart`` taken for one; None when they are many."""
    if len(generators) >= MOST_GENERATED:
        return None
    members = np.eye(3)[None]
    limit = 1 + 2 * np.cos(apart)  # of the trace of inverse(a) @ b
    pending = list(generators)
    while pending:
        product = pending.pop(0)
        if (members.reshape(-1, 9) @ product.ravel()).max() > limit:
            continue
        members = np.concatenate([members, product[None]])
        if len(members) > MOST_GENERATED:
            return None
        pending += list(generators @ product)
    return members
