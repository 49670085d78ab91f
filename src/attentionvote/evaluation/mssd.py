"""MSSD, BOP's maximum symmetry-aware surface distance: how far the worst point of the surface is off, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from attentionvote.evaluation.scene_result import Array
from attentionvote.geometry.pose import inverse, rotation_about, transform

# So many turns that no point moves more than a hundredth of the diameter between two of them: ceil(pi / 0.01).
CONTINUOUS_STEPS = 315
_BLOCK_VALUES = 4_000_000  # numbers in one intermediate array, 32 MB


def symmetry_transforms(discrete: ArrayLike = (), continuous: Sequence[tuple[ArrayLike, ArrayLike]] = ()) -> Array:
    """All symmetries ``(S, 4, 4)`` of a model, ``part_from_part``, as the BOP toolkit expands ``models_info.json``.

    The identity and the discrete ones; with continuous ones each is preceded by every turn about every axis
    (``turn @ discrete``). Axes are not composed with one another.

    Args:
        discrete: ``(K, 4, 4)`` transforms without the identity, metres.
        continuous: axis ``(3,)`` of any length and a point ``(3,)`` on it, metres, of each.
    """
    finite = np.concatenate([np.eye(4)[None], np.asarray(discrete, dtype=np.float64).reshape(-1, 4, 4)])
    if not continuous:
        return finite
    angles = 2 * np.pi * np.arange(CONTINUOUS_STEPS) / CONTINUOUS_STEPS
    turns = []
    for axis, point in continuous:
        rotation, o = rotation_about(axis, angles), np.asarray(point, dtype=np.float64)
        turns.append(transform(rotation, o - rotation @ o))
    return (np.concatenate(turns)[None] @ finite[:, None]).reshape(-1, 4, 4)


@dataclass(frozen=True, eq=False)
class SurfaceDistance:
    """MSSD of one model: ``min over S of max over v of |a v - b S v|`` (Hodan et al. 2020, section 2.2).

    The same numbers as by brute force, with less work: a distance of two moved points is a convex function of the
    point, so the farthest vertex is a corner of the convex hull; and a symmetry whose lower bound, from the hull's
    extremes in a few directions, is above the best found so far is not looked at further.

    Args:
        vertices: of the model ``(V, 3)``, metres.
        symmetries: ``(S, 4, 4)``, of ``symmetry_transforms``.
        reach: metres; poses whose origins are at least so far apart get ``inf``, as in the toolkit, where it is the
            diameter.
    """

    vertices: Array
    symmetries: Array = field(default_factory=lambda: np.eye(4)[None])
    reach: float = np.inf
    _extremes: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        corners = np.asarray(self.vertices, dtype=np.float64).reshape(-1, 3)
        if not len(corners) or not np.isfinite(corners).all():
            raise ValueError(f"a model must have finite vertices, at least one, got {len(corners)}")
        try:
            corners = corners[ConvexHull(corners).vertices]
        except (QhullError, ValueError):  # flat, or too few points for a hull
            corners = np.unique(corners, axis=0)
        directions = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
        object.__setattr__(self, "vertices", corners)
        object.__setattr__(self, "_extremes", corners[np.unique((corners @ directions.T).argmax(0))])

    def distances(self, a: ArrayLike, b: ArrayLike) -> Array:
        """MSSD ``(A, B)`` in metres between poses ``(A, 4, 4)`` and ``(B, 4, 4)``."""
        a, b = (np.asarray(p, dtype=np.float64).reshape(-1, 4, 4) for p in (a, b))
        table = np.full((len(a), len(b)), np.inf)
        gap = np.linalg.norm(a[:, None, :3, 3] - b[None, :, :3, 3], axis=-1)
        rows, columns = np.nonzero(gap < self.reach)
        block = max(1, _BLOCK_VALUES // (3 * len(self.symmetries) * len(self._extremes)))
        for start in range(0, len(rows), block):
            i, j = rows[start : start + block], columns[start : start + block]
            # Both poses seen from the second: no length changes, and the symmetries' points are the same for all.
            table[i, j] = self._least(inverse(b[j]) @ a[i])
        return table

    def _least(self, motions: Array) -> Array:
        """``min over S of max over v of |motion v - S v|`` ``(P,)`` of motions ``(P, 4, 4)``."""
        bound = self._worst(motions[:, None], self.symmetries[None], self._extremes)
        first = bound.argmin(1)
        best = self._worst(motions, self.symmetries[first], self.vertices)
        bound[np.arange(len(motions)), first] = np.inf
        pairs, others = np.nonzero(bound < best[:, None])
        block = max(1, _BLOCK_VALUES // (3 * len(self.vertices)))
        for start in range(0, len(pairs), block):
            p, s = pairs[start : start + block], others[start : start + block]
            np.minimum.at(best, p, self._worst(motions[p], self.symmetries[s], self.vertices))
        return best

    @staticmethod
    def _worst(motions: Array, symmetries: Array, points: Array) -> Array:
        """Largest distance ``(...)`` that a point has between a motion and a symmetry ``(..., 4, 4)``."""
        difference = motions - symmetries
        offset = points @ np.swapaxes(difference[..., :3, :3], -1, -2) + difference[..., None, :3, 3]
        return np.sqrt(np.einsum("...i,...i->...", offset, offset).max(-1))
