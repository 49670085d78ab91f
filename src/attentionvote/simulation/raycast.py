"""Exact ray casting of a pile: one BVH per part, rays moved into the part's frame for every instance.

embreex has no instancing; rebuilding a BVH per scene grows with the mesh, this does not. Rays pass through points
``(x, y, 1)``, unnormalised, so that a hit's ray parameter is its depth z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from attentionvote.geometry.pose import apply, inverse
from attentionvote.part import Part
from attentionvote.simulation.camera import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met first.

    Attributes:
        depth: ``(P,)`` z in metres, part or bin; inf where a ray meets nothing.
        instance: ``(P,)`` int32 index of the instance, -1 for the bin or nothing.
        normal: ``(P, 3)`` unit face normal towards the ray's origin, zero where there is no instance.
    """

    depth: Floats
    instance: NDArray[np.int32]
    normal: Floats


@dataclass(frozen=True, eq=False)
class BinSurface:
    """Floor and thin walls of the bin: ``size`` ``(3,)`` metres inside, ``camera_from_bin`` ``(4, 4)``."""

    size: Floats
    camera_from_bin: Floats

    def depth(self, xy: Floats) -> Floats:
        """Depth ``(P,)`` of the bin along rays ``(P, 2)``, inf where they miss it.

        A ray that enters the box through its open top ends on the floor or the inside of a wall; one that enters
        through a side has met the outside of that wall.
        """
        bin_from_camera = inverse(self.camera_from_bin)
        origin, rotation = bin_from_camera[:3, 3], bin_from_camera[:3, :3]
        # Column by column: a third of the time of arrays (P, 3).
        enter, leave = np.full(len(xy), -np.inf), np.full(len(xy), np.inf)
        for axis in range(3):
            low, high = (0.0, self.size[2]) if axis == 2 else (-self.size[axis] / 2, self.size[axis] / 2)
            direction = xy[:, 0] * rotation[axis, 0] + (xy[:, 1] * rotation[axis, 1] + rotation[axis, 2])
            inverted = 1.0 / np.where(np.abs(direction) < 1e-15, 1e-15, direction)
            a, b = (low - origin[axis]) * inverted, (high - origin[axis]) * inverted
            near = np.minimum(a, b)
            through_top = (near > enter) & (direction < 0)  # holds for the last axis, z
            enter, leave = np.maximum(enter, near), np.minimum(leave, np.maximum(a, b))
        depth = np.where(through_top, leave, enter)
        return np.where((enter < leave) & (depth > 0), depth, np.inf)

    def moved(self, shift: Floats) -> BinSurface:
        """The same bin seen from an origin at ``shift`` ``(3,)`` in the camera frame."""
        pose = self.camera_from_bin.copy()
        pose[:3, 3] -= shift
        return BinSurface(self.size, pose)


class PartCaster:
    """Casts rays at instances of one part. Build one per process; it holds the part's BVH."""

    def __init__(self, part: Part) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.part = part
        triangles = part.vertices[part.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / np.where(length > 0, length, 1.0)
        self._outline = part.vertices[ConvexHull(part.vertices).vertices]
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, triangles.astype(np.float32))

    def cast(
        self, camera_from_part: Floats, xy: Floats, surface: BinSurface | None = None, background: bool = True
    ) -> Hits:
        """First hits of rays from the origin through ``xy`` ``(P, 2)`` on the plane z = 1.

        Args:
            camera_from_part: ``(I, 4, 4)`` poses; every instance must lie in front of the origin (z > 0).
            xy: rays.
            surface: the bin, or None for none.
            background: also compute the bin's depth along rays that meet no instance; inf there otherwise.

        Raises:
            ValueError: when an instance reaches behind the origin.
        """
        # Sorted by x, the rays that can meet an instance are a slice, then a comparison in y.
        order = np.argsort(xy[:, 0])
        rays = np.ones((len(xy), 3), dtype=np.float32)
        rays[:, :2] = xy[order]
        x, y = xy[order, 0], xy[order, 1]
        nearest = np.full(len(xy), np.inf, dtype=np.float32)
        owner = np.full(len(xy), -1, dtype=np.int32)
        face = np.zeros(len(xy), dtype=np.int32)
        low, high = self._outline_boxes(camera_from_part)
        first, last = np.searchsorted(x, low[:, 0], "left"), np.searchsorted(x, high[:, 0], "right")
        for i, pose in enumerate(camera_from_part):
            inside = y[first[i] : last[i]]
            chosen = np.flatnonzero((inside >= low[i, 1]) & (inside <= high[i, 1])) + first[i]
            t, primitive = self._cast_one(pose, rays[chosen])
            closer = (primitive >= 0) & (t < nearest[chosen])
            chosen = chosen[closer]
            nearest[chosen], owner[chosen], face[chosen] = t[closer], i, primitive[closer]
        depth, instance = np.full(len(xy), np.inf), np.full(len(xy), -1, dtype=np.int32)
        normal = np.zeros((len(xy), 3))
        hit = np.flatnonzero(owner >= 0)
        ray, t, owner, face = order[hit], nearest[hit].astype(np.float64), owner[hit], face[hit]
        if surface is not None:
            wall = np.full(len(xy), np.inf)
            wanted = slice(None) if background else ray
            wall[wanted] = surface.depth(xy[wanted])
            depth[:] = wall
            # Parts rest a fraction of a millimetre inside floor and walls: such points still belong to the part.
            front = t < wall[ray] + 0.005 * self.part.diameter
            ray, t, owner, face = ray[front], t[front], owner[front], face[front]
        depth[ray], instance[ray] = t, owner
        turned = np.einsum("pij,pj->pi", camera_from_part[owner, :3, :3], self._normals[face])
        # A closed surface shows its outside; only open ones need the sign.
        away = np.einsum("pi,pi->p", turned[:, :2], xy[ray]) + turned[:, 2] > 0
        normal[ray] = np.where(away[:, None], -turned, turned)
        return Hits(depth, instance, normal)

    def blocked(self, camera_from_part: Floats, points: Floats, margin: float, surface: BinSurface | None) -> NDArray:
        """``(P,)`` bool: the ray to ``points`` ``(P, 3)`` ends more than ``margin`` metres before them."""
        depth = self.cast(camera_from_part, points[:, :2] / points[:, 2:], surface).depth
        return depth < points[:, 2] - margin

    def visible_fraction(
        self, camera_from_part: Floats, camera: Camera, surface: BinSurface | None, stride: int = 2
    ) -> Floats:
        """``(I,)`` share of every instance's own silhouette that the camera sees, from every ``stride``-th pixel.

        The silhouette goes on beyond the picture's border: a part half outside the picture is half visible at most.
        Stride 2 is within 0.003 of every pixel, stride 4 within 0.01.
        """
        count = len(camera_from_part)
        low, high = self._outline_boxes(camera_from_part)
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        size = np.array([camera.width, camera.height])
        first = np.ceil((low * focal + centre) / stride).astype(int)
        last = np.floor((high * focal + centre) / stride).astype(int)
        origin = np.minimum(first.min(axis=0), 0)
        buffer_size = np.maximum(last.max(axis=0), (size - 1) // stride) - origin + 1
        nearest = np.full(buffer_size[::-1], np.inf)
        owner = np.full(buffer_size[::-1], -1, dtype=np.int32)
        silhouette = np.zeros(count)
        for i, pose in enumerate(camera_from_part):
            v, u = np.mgrid[first[i, 1] : last[i, 1] + 1, first[i, 0] : last[i, 0] + 1]
            pixels = np.stack([u.ravel(), v.ravel()], axis=1)
            rays = np.ones((len(pixels), 3), dtype=np.float32)
            rays[:, :2] = camera.rays(pixels * stride)
            t, face = self._cast_one(pose, rays)
            hit = face >= 0
            silhouette[i] = hit.sum()
            row, column = (pixels[hit] - origin).T[::-1]
            closer = t[hit] < nearest[row, column]
            nearest[row[closer], column[closer]] = t[hit][closer]
            owner[row[closer], column[closer]] = i
        row, column = np.nonzero(owner >= 0)
        pixels = (np.stack([column, row], axis=1) + origin) * stride
        seen = ((pixels >= 0) & (pixels < size)).all(axis=1)
        if surface is not None:
            seen &= nearest[row, column] < surface.depth(camera.rays(pixels)) + 0.005 * self.part.diameter
        visible = np.bincount(owner[row, column][seen], minlength=count)
        return visible / np.maximum(silhouette, 1)

    def pixel_box(self, camera_from_part: Floats, camera: Camera) -> tuple[int, int, int, int]:
        """First and last column and row, ``(u0, u1, v0, v1)`` inclusive, of the picture's part that holds the pile."""
        low, high = self._outline_boxes(camera_from_part)
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        u0, v0 = np.maximum(np.ceil(low.min(axis=0) * focal + centre), 0).astype(int)
        u1, v1 = np.minimum(np.floor(high.max(axis=0) * focal + centre), (camera.width - 1, camera.height - 1)).astype(
            int
        )
        return int(u0), int(u1), int(v0), int(v1)

    def _outline_boxes(self, camera_from_part: Floats) -> tuple[Floats, Floats]:
        """Bounds ``(I, 2)``, ``(I, 2)`` of the instances' projections on the plane z = 1."""
        outline = apply(camera_from_part, self._outline)
        if len(outline) and outline[..., 2].min() <= 0:
            raise ValueError(f"{self.part.name}: every instance must lie in front of the camera, one reaches z <= 0")
        projected = outline[..., :2] / outline[..., 2:]
        return projected.min(axis=1) - 1e-9, projected.max(axis=1) + 1e-9

    def _cast_one(self, pose: Floats, rays: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth ``(P,)`` and face ``(P,)``, -1 for a miss, of rays ``(P, 3)`` (x, y, 1) at one instance alone."""
        if not len(rays):
            return np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.int32)
        part_from_camera = inverse(pose)
        direction = rays @ part_from_camera[:3, :3].T.astype(np.float32)
        origin = np.empty_like(direction)
        origin[:] = part_from_camera[:3, 3]
        out = self._scene.run(origin, direction, output=1)
        return out["tfar"], out["primID"]
