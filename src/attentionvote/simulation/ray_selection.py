"""Selection of the rays that are cast: pixels in random order, of their rays those that can meet an instance first.

Nothing that is left out could change a hit: the results are those of all rays at all instances, to the bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import native

Floats = NDArray[np.float64]

# Rounding of single-precision rays and hits stays far below; on the plane z = 1 and as a share of the depth.
_BESIDE, _NEARER = 1e-5, 1e-4


class Windows(NamedTuple):
    """Where instances are seen on the plane z = 1, from the corners of their hulls.

    Attributes:
        low, high: ``(I, 2)`` bounds in x and y.
        across: ``(I, 2)`` unit vector across the outline, the shorter of its principal directions.
        low_across, high_across: ``(I,)`` bounds of the outline's coordinate along it.
        near: ``(I,)`` metres, no hit has less depth.
    """

    low: Floats
    high: Floats
    across: Floats
    low_across: Floats
    high_across: Floats
    near: Floats

    @classmethod
    def empty(cls, count: int) -> Windows:
        """Of ``count`` instances, to be filled."""
        flat, plane = (count,), (count, 2)
        return cls(*(np.empty(shape) for shape in (plane, plane, plane, flat, flat, flat)))

    def fill(self, instances: NDArray[np.bool_], outline: Floats) -> None:
        """Set the windows of the ``instances`` ``(I,)`` from their ``outline`` ``(O, V, 3)``, camera frame."""
        projected = outline[..., :2] / outline[..., 2:]
        self.low[instances], self.high[instances] = projected.min(axis=1) - 1e-9, projected.max(axis=1) + 1e-9
        x, y = np.moveaxis(projected - projected.mean(axis=1, keepdims=True), -1, 0)
        along = np.arctan2(2 * (x * y).sum(axis=1), (x * x).sum(axis=1) - (y * y).sum(axis=1)) / 2
        across = np.stack([-np.sin(along), np.cos(along)], axis=1)
        coordinate = (projected @ across[:, :, None])[..., 0]
        self.across[instances] = across
        self.low_across[instances], self.high_across[instances] = (
            coordinate.min(axis=1) - _BESIDE,
            coordinate.max(axis=1) + _BESIDE,
        )
        self.near[instances] = outline[..., 2].min(axis=1) * (1 - _NEARER)


class NearestHits:
    """What each of ``count`` rays has met so far.

    Attributes:
        nearest: ``(P,)`` depth in metres, inf for nothing.
        owner, face: ``(P,)`` instance, -1 for none, and its face.
    """

    def __init__(self, count: int) -> None:
        self.nearest = np.full(count, np.inf, dtype=np.float32)
        self.owner = np.full(count, -1, dtype=np.int32)
        self.face = np.zeros(count, dtype=np.int32)
        self._library = native.load("attentionvote.simulation", "rays.c")

    def keep(self, ray_ids: NDArray, depth: NDArray[np.float32], face: NDArray[np.int32], instance: int) -> None:
        """Take over hits of the rays ``ray_ids`` ``(C,)`` on an instance, face -1 for none, where they are the nearest.

        Of equally near instances the one with the lowest index stays, whatever the order of the calls.
        """
        if self._library is not None:
            rays, hit = (np.ascontiguousarray(a, dtype=np.int32) for a in (ray_ids, face))
            into = self.nearest, self.owner, self.face
            native.call(self._library.keep_nearer, rays, len(rays), depth, hit, int(instance), *into)
            return
        before = self.nearest[ray_ids]
        nearer = (face >= 0) & ((depth < before) | ((depth == before) & (instance < self.owner[ray_ids])))
        ray_ids = ray_ids[nearer]
        self.nearest[ray_ids], self.owner[ray_ids], self.face[ray_ids] = depth[nearer], instance, face[nearer]


class FirstHits(NearestHits):
    """Hits of rays ``xy`` ``(P, 2)``, which are in the order of x.

    Attributes:
        order: ``(P,)`` index of each ray in ``xy``.
    """

    def __init__(self, xy: Floats) -> None:
        super().__init__(len(xy))
        # Sorted by x, the rays that can meet an instance are a slice, then comparisons.
        self.order = np.argsort(xy[:, 0])
        self._x, self._y = xy[self.order, 0], xy[self.order, 1]
        self._ray_ids = np.empty(len(xy) + 1, dtype=np.int32)
        self._rays = np.empty((len(xy) + 1, 3), dtype=np.float32)

    def slices(self, windows: Windows) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First ray ``(I,)`` that an instance's bounds in x hold, and the one after the last."""
        return (
            np.searchsorted(self._x, windows.low[:, 0], "left"),
            np.searchsorted(self._x, windows.high[:, 0], "right"),
        )

    def select(self, windows: Windows, i: int, first: int, last: int) -> tuple[NDArray, NDArray[np.float32]]:
        """Of the rays ``first..last`` those that can meet instance ``i`` first: indices ``(C,)``, rays ``(C, 3)``.

        Both hold until the next call.
        """
        low, high, across = windows.low[i, 1], windows.high[i, 1], windows.across[i]
        if self._library is None:
            inside = self._y[first:last]
            ray_ids = np.flatnonzero((inside >= low) & (inside <= high)) + first
            rays = np.ones((len(ray_ids), 3), dtype=np.float32)
            rays[:, 0], rays[:, 1] = self._x[ray_ids], self._y[ray_ids]
            return ray_ids, rays
        window = np.array([low, high, *across, windows.low_across[i], windows.high_across[i], windows.near[i]])
        count = np.zeros(1, dtype=np.int32)
        results = window, self._ray_ids, self._rays, count
        native.call(self._library.select_rays, self._x, self._y, self.nearest, int(first), int(last), *results)
        return self._ray_ids[: count[0]], self._rays[: count[0]]


def random_order(count: int, rng: np.random.Generator) -> NDArray[np.int32]:
    """The numbers below ``count`` in random order: ``rng.permutation(count)`` a third of the time, the same draws."""
    library = native.load("attentionvote.simulation", "rays.c")
    if library is None:
        return rng.permutation(count).astype(np.int32)
    order, bits = np.empty(count, dtype=np.int32), rng.bit_generator
    with bits.lock:
        native.call(library.random_order, bits.ctypes.next_uint32, bits.ctypes.state, count, order)
    return order
