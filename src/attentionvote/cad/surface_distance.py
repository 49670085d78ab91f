"""Distance from points to a triangle surface, and how far a rotation carries the surface off itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from attentionvote.geometry.pose import rotation_about
from attentionvote.part import uniform_points

Array = NDArray[np.float64]

PIECES = 5_000  # their longest edge is that of a square of so many that would tile the surface
FIRST_NEIGHBOURS = 8
TEST_POINTS = 1_500
SCREEN_POINTS = 240


class SurfaceDistance:
    """Exact unsigned distance to a triangle surface, of any triangulation.

    The triangles are cut into pieces with short edges; a tree over the pieces' centroids then bounds from
    below the distance of every piece that was not measured, so the search widens until it is certain.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.int64]) -> None:
        """``vertices`` ``(V, 3)`` metres, ``faces`` ``(F, 3)``."""
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        self._pieces = _cut(corners, float(np.sqrt(area / PIECES)))
        centroids = self._pieces.mean(1)
        self._radius = np.linalg.norm(self._pieces - centroids[:, None], axis=-1).max(1)
        self._reach = float(self._radius.max())
        self._tree = cKDTree(centroids)
        normal = np.cross(self._pieces[:, 1] - self._pieces[:, 0], self._pieces[:, 2] - self._pieces[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self._normals = normal / np.where(length > 0, length, 1.0)

    def __call__(self, points: Array, between: tuple[float, float] = (0.0, np.inf)) -> Array:
        """Distance ``(N,)`` in metres of ``points`` ``(N, 3)``; see ``nearest``."""
        return self.nearest(points, between)[0]

    def nearest(self, points: Array, between: tuple[float, float] = (0.0, np.inf)) -> tuple[Array, NDArray[np.int64]]:
        """Distance ``(N,)`` and index of the nearest piece ``(N,)``.

        Outside of ``between`` (metres) the search stops as soon as the distance is known to be below the
        first or above the second; it may then be too large, by less than a piece.
        """
        low, high = between
        first, piece = self._tree.query(points)
        distance = point_triangle_distance(points, self._pieces[piece])
        todo, count = np.arange(len(points)), FIRST_NEIGHBOURS
        is_open = (distance > low) & (first - self._reach < high)
        while is_open.any():
            todo, count = todo[is_open], min(count, len(self._pieces))
            reach, near = (x.reshape(len(todo), count) for x in self._tree.query(points[todo], k=count))
            # Only pieces that may be nearer than the best so far are measured.
            row, column = np.nonzero(reach - self._radius[near] < distance[todo, None])
            each = np.full(near.shape, np.inf)
            each[row, column] = point_triangle_distance(points[todo[row]], self._pieces[near[row, column]])
            rows, best = np.arange(len(todo)), each.argmin(1)
            is_better = each[rows, best] < distance[todo]
            distance[todo[is_better]] = each[rows, best][is_better]
            piece[todo[is_better]] = near[rows, best][is_better]
            floor = reach[:, -1] - self._reach  # no piece left out is nearer
            is_open = (floor < np.minimum(distance[todo], high)) & (distance[todo] > low)
            is_open &= count < len(self._pieces)
            count *= 4
        return distance, piece

    def largest(self, points: Array, low: float, high: float) -> float:
        """Largest distance in metres of ``points`` ``(N, 3)``: exact between ``low`` and ``high``, ``low`` if none is
        larger, and above ``high`` too large by less than a piece.

        Only points that may still be the farthest are measured to the end.
        """
        bound, _ = self.nearest(points, (np.inf, np.inf))
        best = low
        while (bound > best).any():
            farthest = np.argsort(-bound)[:256]
            exact = self(points[farthest], (best, high))
            bound[farthest] = -np.inf
            best = max(best, float(exact.max()))
            if best > high:
                break
        return best

    def roughly(self, points: Array) -> Array:
        """Distance ``(N,)`` to the nearest piece's centroid: fast, too large by up to a piece's radius."""
        return np.asarray(self._tree.query(points)[0])

    def offset(self, points: Array) -> tuple[Array, Array]:
        """Signed height ``(N,)`` over the plane of the nearest piece, and its normal ``(N, 3)``."""
        _, piece = self.nearest(points)
        normal = self._normals[piece]
        return np.einsum("ni,ni->n", points - self._pieces[piece, 0], normal), normal


def _cut(triangles: Array, longest: float) -> Array:
    """Triangles ``(N, 3, 3)`` halved at their longest edge until no edge exceeds ``longest``."""
    done = []
    while len(triangles):
        lengths = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=-1)
        is_long = lengths.max(1) > longest
        done.append(triangles[~is_long])
        triangles, edge = triangles[is_long], lengths[is_long].argmax(1)
        rows = np.arange(len(triangles))
        a, b, c = (triangles[rows, (edge + i) % 3] for i in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done)


def point_triangle_distance(points: Array, triangles: Array) -> Array:
    """Exact distance ``(N,)`` of ``points`` ``(N, 3)`` to ``triangles`` ``(N, 3, 3)``, one each."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    edges = [_segment_distance(points, *pair) for pair in ((a, b), (b, c), (c, a))]
    inside = length > 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside = inside & (np.einsum("ni,ni->n", np.cross(end - start, points - start), normal) >= 0)
    plane = np.abs(np.einsum("ni,ni->n", points - a, normal)) / np.where(length > 0, length, 1.0)
    return np.where(inside, plane, np.minimum.reduce(edges))


def _segment_distance(points: Array, start: Array, end: Array) -> Array:
    along, to_point = end - start, points - start
    squared = np.einsum("ni,ni->n", along, along)
    share = np.einsum("ni,ni->n", to_point, along) / np.where(squared > 0, squared, 1.0)
    return np.linalg.norm(to_point - np.clip(share, 0, 1)[:, None] * along, axis=1)


class RotationCheck:
    """How far rotations about the origin carry a surface off itself.

    The points checked are uniform samples and the mesh's own vertices (at most ``TEST_POINTS`` of each):
    corners are where a surface that is nearly symmetric differs most.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.int64], tolerance: float) -> None:
        """``vertices`` about the point that every rotation leaves in place; ``tolerance`` in metres."""
        rng = np.random.default_rng(0)
        self.distance = SurfaceDistance(vertices, faces)
        self.tolerance = tolerance
        self.radius = float(np.linalg.norm(vertices, axis=1).max())
        corners = vertices[rng.permutation(np.unique(faces))[:TEST_POINTS]]
        self.points = rng.permutation(np.concatenate([uniform_points(vertices[faces], TEST_POINTS, rng)[0], corners]))
        # The outermost points move most, so a screening set of half of them fails a wrong rotation at once.
        outer = np.argsort(-np.linalg.norm(self.points, axis=1))[: SCREEN_POINTS // 2]
        self.screen = np.concatenate([self.points[outer], self.points[: SCREEN_POINTS // 2]])

    def residual(self, rotation: Array, points: Array | None = None, low: float | None = None) -> float:
        """Largest distance in metres between surface and turned surface, both ways.

        Exact from ``low`` (default: 1 % of the tolerance, below which nothing matters) to twice the tolerance; a larger
        one is somewhat larger than true.
        """
        p = self.points if points is None else points
        low = 0.01 * self.tolerance if low is None else low
        return self.distance.largest(np.concatenate([p @ rotation.T, p @ rotation]), low, 2 * self.tolerance)

    def mean(self, rotation: Array) -> float:
        """Mean distance of the screening points, rough and fast: what searches minimise."""
        return float(self.distance.roughly(self.screen @ rotation.T).mean())

    def worst(self, rotations: Array) -> float:
        """Largest residual of ``rotations`` ``(R, 3, 3)`` over the screening points: a lower bound of the true one."""
        return max((self.residual(r, self.screen) for r in rotations), default=0.0)

    def holds(self, rotations: Array) -> bool:
        """Whether every one of ``rotations`` leaves the surface in place within the tolerance."""
        order = np.argsort(np.trace(rotations, axis1=1, axis2=2))  # large angles fail first
        stages = (self.screen[:: SCREEN_POINTS // 16], self.screen, self.points)  # most fail at the first points
        limit = self.tolerance
        return all(self.residual(rotations[i], points, limit) <= limit for points in stages for i in order)

    def refined(self, rotation: Array, rounds: int = 12) -> Array:
        """The rotation near ``rotation`` that fits the surface best: point-to-plane registration about the origin.

        Heights above 10 % of the radius are clipped, so that what does not match pulls no harder.
        """
        result = rotation
        for _ in range(rounds):
            turned = self.screen @ result.T
            height, normal = self.distance.offset(turned)
            lever = np.cross(turned, normal)
            height = np.clip(height, -0.1 * self.radius, 0.1 * self.radius)
            # The damping keeps directions in which the surface does not resist (a revolution's) where they are.
            damping = 1e-6 * len(turned) * self.radius**2 * np.eye(3)
            step = -np.linalg.solve(lever.T @ lever + damping, lever.T @ height)
            angle = float(np.linalg.norm(step))
            if angle < 1e-9:
                break
            result = rotation_about(step, min(angle, 0.1)) @ result
        return result
