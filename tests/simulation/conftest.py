"""Parts, piles and slow references of the scene tests.

Fixtures return functions where a test wants several variants: test modules cannot import each other.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord

# An angle bracket of two boxes, low corner and size in metres: convex pieces known exactly, no symmetry.
BOXES = (((-0.03, -0.01, -0.01), (0.06, 0.02, 0.008)), ((-0.03, -0.01, -0.01), (0.008, 0.02, 0.04)))


def bracket_hulls() -> tuple[NDArray, ...]:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return tuple(np.array(low) + corners * size for low, size in BOXES)


@pytest.fixture(scope="session")
def bracket() -> Part:
    boxes = [trimesh.convex.convex_hull(hull) for hull in bracket_hulls()]
    mesh = trimesh.boolean.union(boxes, engine="manifold")
    return Part("bracket", np.array(mesh.vertices), np.array(mesh.faces), 0.08)


@pytest.fixture(scope="session")
def hulls() -> tuple[NDArray, ...]:
    return bracket_hulls()


@pytest.fixture(scope="session")
def caster(bracket: Part) -> PartCaster:
    return PartCaster(bracket)


@pytest.fixture
def hull_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache directory for convex pieces."""
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def heap() -> Callable[..., NDArray]:
    """``camera_from_part`` of overlapping, randomly turned parts 0.4 m before the camera (no physics)."""

    def make(count: int, seed: int = 0, spread: float = 0.04) -> NDArray:
        rng = np.random.default_rng(seed)
        place = np.array([0, 0, 0.4]) + rng.uniform(-spread, spread, size=(count, 3))
        return transform(matrix_from_quaternion(random_quaternion(rng, (count,))), place)

    return make


@pytest.fixture(scope="session")
def scene_record(heap: Callable[..., NDArray], caster: PartCaster) -> Callable[..., SceneRecord]:
    """A record of ``count`` parts in a bin 0.4 m before the camera."""

    def make(count: int = 6, seed: int = 0) -> SceneRecord:
        poses, camera = heap(count, seed), Camera(300, 240, 500.0, 500.0, 150.0, 120.0)
        return SceneRecord(
            cycle=0,
            drop_count=count,
            camera_from_part=poses,
            visible_fraction=caster.visible_fraction(poses, camera, None),
            camera=camera,
            camera_from_bin=transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.48)),
            bin_size=np.array([0.22, 0.18, 0.1]),
            friction=0.4,
            scene_seed=7,
        )

    return make


@pytest.fixture(scope="session")
def slow() -> SimpleNamespace:
    """Brute force over every triangle."""
    return SimpleNamespace(
        posed=posed_triangles, cast=ray_triangles, distance=distance_to_triangles, inside=inside_mesh
    )


def posed_triangles(part: Part, poses: NDArray) -> NDArray:
    """``(I, F, 3, 3)`` triangles of every instance."""
    return np.stack([apply(pose, part.vertices)[part.faces] for pose in poses])


def ray_triangles(origin: NDArray, directions: NDArray, triangles: NDArray) -> tuple[NDArray, NDArray]:
    """Nearest hit parameter ``(P,)`` (inf for none) and triangle ``(P,)``, Moeller-Trumbore on all pairs."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(directions[:, None], e2)
    determinant = np.einsum("fi,pfi->pf", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = np.einsum("fi,pfi->pf", s, p) / determinant
        q = np.cross(s, e1)
        v = np.einsum("pi,fi->pf", directions, q) / determinant
        t = np.einsum("fi,fi->f", e2, q) / determinant
        hit = (np.abs(determinant) > 1e-16) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    t = np.where(hit, t, np.inf)
    return t.min(axis=1), t.argmin(axis=1)


def distance_to_triangles(points: NDArray, triangles: NDArray) -> NDArray:
    """Distance ``(P,)`` of points to a surface: the foot point if it lies inside the triangle, else the edges."""
    best = np.full(len(points), np.inf)
    for start in range(0, len(points), 500):
        p = points[start : start + 500, None]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        normal = np.cross(b - a, c - a)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        height = np.einsum("pfi,fi->pf", p - a, normal)
        inside = np.ones(height.shape, dtype=bool)
        distance = np.full(height.shape, np.inf)
        for u, v in ((a, b), (b, c), (c, a)):
            edge = v - u
            inside &= np.einsum("pfi,fi->pf", p - u, np.cross(normal, edge)) >= 0
            along = np.einsum("pfi,fi->pf", p - u, edge) / np.maximum((edge**2).sum(axis=1), 1e-30)
            foot = u + np.clip(along, 0, 1)[..., None] * edge
            distance = np.minimum(distance, np.linalg.norm(p - foot, axis=2))
        best[start : start + 500] = np.where(inside, np.abs(height), distance).min(axis=1)
    return best


def inside_mesh(points: NDArray, triangles: NDArray) -> NDArray[np.bool_]:
    """Whether points ``(P,)`` lie inside a closed surface: winding number by solid angles (Van Oosterom 1983)."""
    winding = np.zeros(len(points))
    for start in range(0, len(points), 500):
        a, b, c = (triangles[None, :, i] - points[start : start + 500, None] for i in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
        numerator = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
        dot = lambda x, y: np.einsum("pfi,pfi->pf", x, y)  # noqa: E731
        denominator = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        winding[start : start + 500] = np.arctan2(numerator, denominator).sum(axis=1) / (2 * np.pi)
    return winding > 0.5
