"""How far a rotation carries a surface off itself, beyond what the surface's tessellation explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.surface_distance import SurfaceDistance
from attentionvote.cad.tessellation import facet_heights
from attentionvote.geometry.pose import rotation_about
from attentionvote.part import uniform_points

Array = NDArray[np.float64]

TEST_POINTS = 1_500
SCREEN_POINTS = 240
SETTLED = 0.01  # of the tolerance, a step of the registration after which there is nothing to gain
ALLOWANCE = 1.05  # of a facet's height: facets of one circle are not all alike


class RotationCheck:
    """Rotations of a surface about points near the origin.

    The points checked are uniform samples and the mesh's own vertices (at most ``TEST_POINTS`` of each): corners are
    where a surface that is nearly symmetric differs most. Where a tessellated curve meets another facet of its own, as
    far as the facets' height is no difference; a plane, an edge or a tooth has no such allowance.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.int64], tolerance: float) -> None:
        """``vertices`` ``(V, 3)`` metres about a point that every rotation leaves nearly in place; ``tolerance`` in
        metres."""
        rng = np.random.default_rng(0)
        self.distance = SurfaceDistance(vertices, faces)
        self.tolerance = tolerance
        self.radius = float(np.linalg.norm(vertices, axis=1).max())
        triangles = vertices[faces]
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self._normals = normal / np.where(length > 0, length, 1.0)
        heights = facet_heights(vertices, faces)
        curved = heights > 0
        self._curves = SurfaceDistance(vertices, faces[curved]) if curved.any() else None
        self._heights = ALLOWANCE * heights[curved]
        self.facet_height = float(heights.max())
        corners = vertices[rng.permutation(np.unique(faces))[:TEST_POINTS]]
        self.points = rng.permutation(np.concatenate([uniform_points(triangles, TEST_POINTS, rng)[0], corners]))
        # The outermost points move most, so a screening set of half of them fails a wrong rotation at once.
        outer = np.argsort(-np.linalg.norm(self.points, axis=1))[: SCREEN_POINTS // 2]
        self.screen = np.concatenate([self.points[outer], self.points[: SCREEN_POINTS // 2]])

    def residual(self, rotation: Array, points: Array | None = None, centre: Array | float = 0.0) -> float:
        """Largest distance in metres between surface and surface turned about ``centre`` ``(3,)``, both ways, beyond
        the heights of the facets that meet."""
        p = (self.points if points is None else points) - centre
        turned = np.concatenate([p @ rotation.T, p @ rotation]) + centre
        return float(self._beyond_facets(np.concatenate([p, p]) + centre, turned, self.tolerance).max(initial=0.0))

    def roughly(self, rotations: Array) -> float:
        """As ``residual`` of the worst of ``rotations`` ``(R, 3, 3)``, over a few points and in one go."""
        points = self.screen[:: SCREEN_POINTS // 30]
        turned = np.einsum("rij,pj->rpi", rotations, points).reshape(-1, 3)
        here = np.broadcast_to(points, (len(rotations), *points.shape)).reshape(-1, 3)
        return float(self._beyond_facets(here, turned, self.tolerance).max(initial=0.0))

    def distances(self, rotation: Array, translation: Array) -> Array:
        """Distances ``(P,)`` in metres of the turned and moved test points to the surface."""
        return self.distance(self.points @ rotation.T + translation)

    def excess(self, rotation: Array, translation: Array) -> float:
        """Largest distance in metres of the turned, or mirrored, and moved test points to the surface, beyond the
        heights of the facets that meet."""
        turned = self.points @ rotation.T + translation
        return float(self._beyond_facets(self.points, turned, 0.0).max(initial=0.0))

    def means(self, rotations: Array, most: int = 96) -> Array:
        """Mean distances ``(R,)`` in metres of some screening points under ``rotations`` ``(R, 3, 3)``: what searches
        minimise."""
        points = self.screen[:: max(1, len(self.screen) // most)]
        turned = np.einsum("rij,pj->rpi", rotations, points)
        return np.asarray(self.distance(turned.reshape(-1, 3)).reshape(turned.shape[:2]).mean(1))

    def worst(self, rotations: Array, centre: Array | float = 0.0) -> float:
        """Largest residual of ``rotations`` ``(R, 3, 3)`` over the screening points, a lower bound of the true one;
        over all points where these do not tell that any fails."""
        screened = max((self.residual(r, self.screen, centre) for r in rotations), default=0.0)
        if screened > self.tolerance:
            return screened
        return max((self.residual(r, None, centre) for r in rotations), default=0.0)

    def holds(self, rotations: Array, centre: Array | float = 0.0) -> bool:
        """Whether every one of ``rotations`` about ``centre`` leaves the surface in place within the tolerance."""
        order = np.argsort(np.trace(rotations, axis1=1, axis2=2))  # large angles fail first
        stages = (self.screen[:: SCREEN_POINTS // 16], self.screen, self.points)  # most fail at the first points
        return all(self.residual(rotations[i], points, centre) <= self.tolerance for points in stages for i in order)

    def registered(self, rotation: Array, rounds: int = 12, points: Array | None = None) -> tuple[Array, Array]:
        """The rigid motion near ``rotation`` that fits the surface best: rotation ``(3, 3)`` and translation ``(3,)``.

        Point-to-plane registration of the screening points, or of ``points`` ``(N, 3)``. Heights above 10 % of the
        radius are clipped, so that what does not match pulls no harder.
        """
        screen = self.screen if points is None else points
        turn, shift = rotation, np.zeros(3)
        # The damping keeps directions in which the surface does not resist (a revolution's) where they are.
        damping = 1e-6 * len(screen) * np.diag([self.radius**2] * 3 + [1.0] * 3)
        for _ in range(rounds):
            turned = screen @ turn.T
            nearest = self.distance.nearest(turned + shift)
            normal = self._normals[nearest.face]
            height = np.einsum("ni,ni->n", turned + shift - nearest.point, normal)
            height = np.clip(height, -0.1 * self.radius, 0.1 * self.radius)
            lever = np.concatenate([np.cross(turned, normal), normal], axis=1)
            step = -np.linalg.solve(lever.T @ lever + damping, lever.T @ height)
            angle = float(np.linalg.norm(step[:3]))
            turn = rotation_about(step[:3] if angle > 0 else (0, 0, 1), min(angle, 0.1)) @ turn
            shift = shift + step[3:]
            if angle * self.radius + np.linalg.norm(step[3:]) < SETTLED * self.tolerance:
                break
        return turn, shift

    def centre(self, rotations: Array) -> Array:
        """The point ``(3,)`` metres nearest to the origin about which ``rotations`` ``(R, 3, 3)`` fit the surface best.

        The centroid of a surface whose curves are tessellated unevenly lies beside the axis of its symmetry, by a share
        of the facets' height.
        """
        if not self.facet_height:
            return np.zeros(3)
        motions = [self.registered(r, rounds=6, points=self.points) for r in rotations]
        rows = np.concatenate([np.eye(3) - r for r in rotations])
        shifts = np.concatenate([shift for _, shift in motions])
        # Along the axis of the turns nothing is known, and 0 is taken.
        centre = np.linalg.lstsq(rows, shifts, rcond=0.1)[0]
        return np.asarray(centre * min(1.0, self.facet_height / max(float(np.linalg.norm(centre)), 1e-300)))

    def _beyond_facets(self, here: Array, turned: Array, above: float) -> Array:
        """Distances ``(N,)`` of ``turned`` ``(N, 3)`` to the surface; of those above ``above`` the heights of the
        facets there and at ``here`` ``(N, 3)``, where the points come from, are taken away."""
        distance = self.distance(turned)
        high = np.flatnonzero(distance > above) if self._curves else np.zeros(0, dtype=np.int64)
        if len(high):
            distance[high] -= np.maximum(self._allowance(here[high]), self._allowance(turned[high]))
        return distance

    def _allowance(self, points: Array) -> Array:
        """Height ``(N,)`` of the facets of a curve that ``points`` ``(N, 3)`` belong to, 0 away from curves."""
        assert self._curves is not None
        nearest = self._curves.nearest(points)
        height = self._heights[nearest.face]
        return np.where(nearest.distance <= height + self.tolerance, height, 0.0)
