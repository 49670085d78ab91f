"""Distance from points to a triangle surface: Open3D's ray casting scene, in units of the surface's own size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


NEEDLE = 100.0  # square of the longest edge over twice the area
MOST_PIECES = 500  # that a needle across the whole surface may become
LOW = 1e-6  # of the surface's size, the height of a needle that need not be cut


class Nearest(NamedTuple):
    """The surface at its nearest to ``N`` points: distance ``(N,)`` and point ``(N, 3)`` in metres, face ``(N,)``."""

    distance: Array
    point: Array
    face: NDArray[np.int64]


class SurfaceDistance:
    """Unsigned distance to a triangle surface, of any triangulation.

    Open3D computes in single precision, about the middle of the surface and in units of its size: distances are exact
    to some millionths of that size. To a triangle that is a thousand times as long as high they would be wrong by its
    height (measured: .03 mm on a ring of 100 mm with the triangles of a boolean), so needles are cut first.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.int64]) -> None:
        """``vertices`` ``(V, 3)`` metres, ``faces`` ``(F, 3)``; ``size`` is the diagonal of their box in metres."""
        from open3d.core import Tensor  # 1.2 s of import: only where a part is looked at
        from open3d.t.geometry import RaycastingScene

        self._tensor = Tensor.from_numpy
        triangles, self._face = _needles_cut(np.asarray(vertices[faces], dtype=np.float64))
        low, high = triangles.min((0, 1)), triangles.max((0, 1))
        self._middle, self.size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        # One thread: the calls are a few milliseconds each, and the other cores have work of their own.
        self._scene = RaycastingScene(nthreads=1)
        corners = self._scaled(triangles.reshape(-1, 3))
        index = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(self._tensor(corners), self._tensor(index))

    def __call__(self, points: Array) -> Array:
        """Distance ``(N,)`` in metres of ``points`` ``(N, 3)``."""
        distance = self._scene.compute_distance(self._tensor(self._scaled(points)), nthreads=1)
        return np.asarray(distance.numpy().astype(np.float64) * self.size)

    def nearest(self, points: Array) -> Nearest:
        """The nearest point of the surface to each of ``points`` ``(N, 3)`` metres."""
        scaled = self._scaled(points)
        answer = self._scene.compute_closest_points(self._tensor(scaled), nthreads=1)
        nearest = answer["points"].numpy()
        distance = np.linalg.norm((nearest - scaled).astype(np.float64), axis=1) * self.size
        face = self._face[answer["primitive_ids"].numpy().astype(np.int64)]
        return Nearest(distance, nearest * self.size + self._middle, face)

    def cast(self, origins: Array, direction: Array) -> tuple[Array, Array]:
        """First hits of parallel rays: distance ``(N,)`` from ``origins`` ``(N, 3)`` metres along the unit
        ``direction`` ``(3,)``, inf where they miss, and the face's unit normal ``(N, 3)``."""
        towards = np.broadcast_to(direction.astype(np.float32), (len(origins), 3))
        rays = np.concatenate([self._scaled(origins), towards], axis=1)
        answer = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        distance = answer["t_hit"].numpy().astype(np.float64) * self.size
        return distance, answer["primitive_normals"].numpy().astype(np.float64)

    def _scaled(self, points: Array) -> NDArray[np.float32]:
        return np.ascontiguousarray((points - self._middle) / self.size, dtype=np.float32)


def _needles_cut(triangles: Array) -> tuple[Array, NDArray[np.int64]]:
    """Triangles ``(N, 3, 3)`` with the needles among ``(F, 3, 3)`` halved at their longest edge until they are none,
    and the face ``(N,)`` that each is of."""
    done, faces = [], []
    face = np.arange(len(triangles))
    size = float(np.linalg.norm(np.ptp(triangles, axis=(0, 1))))
    while len(triangles):
        lengths = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=-1)
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        longest = lengths.max(1)
        # What is hardly high can hardly be wrong.
        is_needle = (longest**2 > NEEDLE * area) & (longest > size / MOST_PIECES) & (area > LOW * size * longest)
        done.append(triangles[~is_needle])
        faces.append(face[~is_needle])
        triangles, edge, face = triangles[is_needle], lengths[is_needle].argmax(1), face[is_needle]
        rows = np.arange(len(triangles))
        a, b, c = (triangles[rows, (edge + i) % 3] for i in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        face = np.concatenate([face, face])
    return np.concatenate(done), np.concatenate(faces)
