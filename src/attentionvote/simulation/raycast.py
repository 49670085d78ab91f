"""Exact ray casting of a pile: one BVH per kind of part, rays moved into the part's frame for every instance.

embreex has no instancing; rebuilding a BVH per scene grows with the mesh, this does not. Rays pass through points
``(x, y, 1)``, unnormalised, so that a hit's ray parameter is its depth z.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from attentionvote.geometry import native
from attentionvote.geometry.pose import apply, inverse
from attentionvote.part import Parts
from attentionvote.simulation.bin_walls import Walls, bin_mesh
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.ray_selection import FirstHits, NearestHits, Windows

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
    """The bin: ``size`` ``(3,)`` metres inside, ``camera_from_bin`` ``(4, 4)``; ``walls`` None are thin and upright."""

    size: Floats
    camera_from_bin: Floats
    walls: Walls | None = None

    def depth(self, xy: Floats) -> Floats:
        """Depth ``(P,)`` of the bin along rays ``(P, 2)``, inf where they miss it.

        A ray that enters the box through its open top ends on the floor or the inside of a wall; one that enters
        through a side has met the outside of that wall. Walls with a shape are a surface as parts are.
        """
        bin_from_camera = inverse(self.camera_from_bin)
        if self.walls is not None:
            scene = _walled_bin(tuple(float(side) for side in self.size), self.walls)[0]
            rays = np.ones((len(xy), 3), dtype=np.float32)
            rays[:, :2] = xy
            hit_depth, face = _cast(scene, bin_from_camera, rays)
            return np.where(face >= 0, hit_depth, np.inf).astype(np.float64)
        library = native.load("attentionvote.simulation", "rays.c")
        if library is not None:
            depth, rays = np.empty(len(xy)), np.ascontiguousarray(xy, dtype=np.float64)
            native.call(library.bin_depth, rays, len(rays), bin_from_camera, np.asarray(self.size, np.float64), depth)
            return depth
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
        return BinSurface(self.size, pose, self.walls)


@lru_cache(maxsize=16)
def _walled_bin(size: tuple[float, float, float], walls: Walls) -> tuple[Any, Any]:
    """Embree's scene and mesh of a bin, in the bin's frame: the scenes of a cycle share one."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    vertices, faces = bin_mesh(np.array(size), walls)
    scene = EmbreeScene()
    return scene, TriangleMesh(scene, vertices[faces].astype(np.float32))


def _cast(scene: Any, from_camera: Floats, rays: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth ``(P,)`` and face ``(P,)``, -1 for a miss, of rays ``(P, 3)`` (x, y, 1) at a scene with its own frame."""
    if not len(rays):
        return np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.int32)
    direction = rays @ from_camera[:3, :3].T.astype(np.float32)
    # Embree wants an origin for every ray: all are the same three numbers.
    origin = as_strided(from_camera[:3, 3].astype(np.float32), direction.shape, (0, 4))
    out = scene.run(origin, direction, output=1)
    return out["tfar"], out["primID"]


class _Surface(NamedTuple):
    """A part as rays meet it: corners ``(V, 3)`` of its hull, embree's scene and mesh."""

    outline: Floats
    scene: Any
    mesh: Any  # embree only points at it


class PartCaster:
    """Casts rays at instances of one part, or of a set. Build one per process; it holds the parts' BVHs.

    Which part an instance is stands in ``part_ids`` ``(I,)``; left out, all are the first.
    """

    def __init__(self, part: Parts) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.part = part
        self._surfaces: list[_Surface] = []
        normals = []
        for member in part.parts:
            triangles = member.vertices[member.faces]
            normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            normals.append(normal / np.where(length > 0, length, 1.0))
            scene = EmbreeScene()
            mesh = TriangleMesh(scene, triangles.astype(np.float32))
            outline = member.vertices[ConvexHull(member.vertices).vertices]
            self._surfaces.append(_Surface(outline, scene, mesh))
        self._normals = np.concatenate(normals)
        self._first_face = np.cumsum([0, *(len(normal) for normal in normals[:-1])])
        # Parts rest a fraction of a millimetre inside floor and walls: such points still belong to the part.
        self._sunk = np.array([0.005 * member.diameter for member in part.parts])

    def cast(
        self,
        camera_from_part: Floats,
        xy: Floats,
        surface: BinSurface | None = None,
        part_ids: NDArray[np.int32] | None = None,
        background: bool = True,
        normals: bool = True,
    ) -> Hits:
        """First hits of rays from the origin through ``xy`` ``(P, 2)`` on the plane z = 1.

        Args:
            camera_from_part: ``(I, 4, 4)`` poses; every instance must lie in front of the origin (z > 0).
            xy: rays.
            surface: the bin, or None for none.
            part_ids: ``(I,)`` which part each instance is.
            background: also compute the bin's depth along rays that meet no instance; inf there otherwise.
            normals: also compute the normals; all zero otherwise.

        Raises:
            ValueError: when an instance reaches behind the origin.
        """
        kinds = _kinds(part_ids, len(camera_from_part))
        windows, hits = self._windows(camera_from_part, kinds), FirstHits(xy)
        first, last = hits.slices(windows)
        # What lies nearer hides rays from the rest.
        part_from_camera = inverse(camera_from_part)
        for i in np.argsort(windows.near, kind="stable"):
            ray_ids, rays = hits.select(windows, i, first[i], last[i])
            hits.keep(ray_ids, *self._cast_instance(kinds[i], part_from_camera[i], rays), i)
        depth, instance = np.full(len(xy), np.inf), np.full(len(xy), -1, dtype=np.int32)
        normal = np.zeros((len(xy), 3))
        hit = np.flatnonzero(hits.owner >= 0)
        ray, t = hits.order[hit], hits.nearest[hit].astype(np.float64)
        owner, face = hits.owner[hit], hits.face[hit]
        if surface is not None:
            if background:
                depth = surface.depth(xy)
            else:
                depth[ray] = surface.depth(xy.take(ray, axis=0))
            front = np.flatnonzero(t < depth[ray] + self._sunk[kinds[owner]])
            ray, t, owner, face = ray[front], t[front], owner[front], face[front]
        depth[ray], instance[ray] = t, owner
        if not normals:
            return Hits(depth, instance, normal)
        turned = np.einsum(
            "pij,pj->pi", camera_from_part[owner, :3, :3], self._normals[self._first_face[kinds[owner]] + face]
        )
        # A closed surface shows its outside; only open ones need the sign.
        away = np.einsum("pi,pi->p", turned[:, :2], xy[ray]) + turned[:, 2] > 0
        normal[ray] = np.where(away[:, None], -turned, turned)
        return Hits(depth, instance, normal)

    def blocked(
        self,
        camera_from_part: Floats,
        points: Floats,
        margin: float,
        surface: BinSurface | None,
        part_ids: NDArray[np.int32] | None = None,
    ) -> NDArray:
        """``(P,)`` bool: the ray to ``points`` ``(P, 3)`` ends more than ``margin`` metres before them."""
        xy = points[:, :2] / points[:, 2:]
        depth = self.cast(camera_from_part, xy, surface, part_ids, normals=False).depth
        return depth < points[:, 2] - margin

    def visible_fraction(
        self,
        camera_from_part: Floats,
        camera: Camera,
        surface: BinSurface | None,
        stride: int = 2,
        part_ids: NDArray[np.int32] | None = None,
    ) -> Floats:
        """``(I,)`` share of every instance's own silhouette that the camera sees, from every ``stride``-th pixel.

        The silhouette goes on beyond the picture's border: a part half outside the picture is half visible at most.
        Stride 2 is within 0.003 of every pixel, stride 4 within 0.01.
        """
        count = len(camera_from_part)
        kinds = _kinds(part_ids, count)
        windows = self._windows(camera_from_part, kinds)
        low, high = windows.low, windows.high
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        size = np.array([camera.width, camera.height])
        first = np.ceil((low * focal + centre) / stride).astype(int)
        last = np.floor((high * focal + centre) / stride).astype(int)
        origin = np.minimum(first.min(axis=0), 0)
        buffer_size = np.maximum(last.max(axis=0), (size - 1) // stride) - origin + 1
        hits, silhouette = NearestHits(int(buffer_size.prod())), np.zeros(count)
        for i, part_from_camera in enumerate(inverse(camera_from_part)):
            # A ray's x is its column's, its y its row's.
            column, row = (np.arange(first[i, axis], last[i, axis] + 1) for axis in range(2))
            x = ((column * stride - centre[0]) / focal[0]).astype(np.float32)
            y = ((row * stride - centre[1]) / focal[1]).astype(np.float32)
            across = x * np.float32(windows.across[i, 0]) + (y * np.float32(windows.across[i, 1]))[:, None]
            meets = (across >= windows.low_across[i]) & (across <= windows.high_across[i])
            if np.count_nonzero(meets) < 2:  # one ray is turned by another routine than many, with another rounding
                meets[:] = True
            cells = np.flatnonzero(meets)
            v = cells // max(len(x), 1)
            u = cells - v * len(x)
            rays = np.ones((len(u), 3), dtype=np.float32)
            rays[:, 0], rays[:, 1] = x[u], y[v]
            depth, face = self._cast_instance(kinds[i], part_from_camera, rays)
            silhouette[i] = np.count_nonzero(face >= 0)
            pixel = (row[v] - origin[1]) * buffer_size[0] + (column[u] - origin[0])
            hits.keep(pixel, depth, face, i)
        hit_pixels = np.flatnonzero(hits.owner >= 0)
        owner, row = hits.owner[hit_pixels], hit_pixels // buffer_size[0]
        pixels = (np.stack([hit_pixels - row * buffer_size[0], row], axis=1) + origin) * stride
        seen = ((pixels >= 0) & (pixels < size)).all(axis=1)
        if surface is not None:
            seen &= hits.nearest[hit_pixels] < surface.depth(camera.rays(pixels)) + self._sunk[kinds[owner]]
        visible = np.bincount(owner[seen], minlength=count)
        return visible / np.maximum(silhouette, 1)

    def pixel_box(
        self, camera_from_part: Floats, camera: Camera, part_ids: NDArray[np.int32] | None = None
    ) -> tuple[int, int, int, int]:
        """First and last column and row, ``(u0, u1, v0, v1)`` inclusive, of the picture's part that holds the pile."""
        low, high = self._windows(camera_from_part, _kinds(part_ids, len(camera_from_part)))[:2]
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        u0, v0 = np.maximum(np.ceil(low.min(axis=0) * focal + centre), 0).astype(int)
        u1, v1 = np.minimum(np.floor(high.max(axis=0) * focal + centre), (camera.width - 1, camera.height - 1)).astype(
            int
        )
        return int(u0), int(u1), int(v0), int(v1)

    def _windows(self, camera_from_part: Floats, kinds: NDArray[np.int32]) -> Windows:
        """Where the instances are on the plane z = 1."""
        windows = Windows.empty(len(kinds))
        for kind, part in enumerate(self.part.parts):
            of_kind = kinds == kind
            if not of_kind.any():
                continue
            outline = apply(camera_from_part[of_kind], self._surfaces[kind].outline)
            if outline[..., 2].min() <= 0:
                raise ValueError(f"{part.name}: every instance must lie in front of the camera, one reaches z <= 0")
            windows.fill(of_kind, outline)
        return windows

    def _cast_instance(
        self, kind: int, part_from_camera: Floats, rays: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth ``(P,)`` and face ``(P,)``, -1 for a miss, of rays ``(P, 3)`` (x, y, 1) at one instance alone."""
        return _cast(self._surfaces[kind].scene, part_from_camera, rays)


def _kinds(part_ids: NDArray[np.int32] | None, count: int) -> NDArray[np.int32]:
    return np.zeros(count, dtype=np.int32) if part_ids is None else part_ids
