"""Bins with a shape: a closed surface, the same for rays and physics; without one, what they always were."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from attentionvote.geometry.pose import apply, rotation_about, transform
from attentionvote.part import Part
from attentionvote.simulation import drop
from attentionvote.simulation.bin_walls import Walls, bin_mesh, bin_outlines, wall_pieces, wall_planes
from attentionvote.simulation.decomposition import Hulls
from attentionvote.simulation.drop import Solid, drop_parts
from attentionvote.simulation.drop_settings import BinSettings, DropSettings
from attentionvote.simulation.mass import mass_properties
from attentionvote.simulation.raycast import BinSurface, PartCaster

SIZE = np.array([0.30, 0.20, 0.10])
shapes = st.builds(
    Walls,
    thickness=st.floats(0.001, 0.02),
    rim=st.sampled_from([0.0, 0.004, 0.02]),
    rim_height=st.floats(0.002, 0.05),
    radius=st.sampled_from([0.0, 0.005, 0.03]),
    draft_degrees=st.sampled_from([0.0, 2.0, 12.0]),
)


@given(shapes)
def test_a_bin_is_a_closed_surface_of_its_outer_size(walls: Walls) -> None:
    mesh = trimesh.Trimesh(*bin_mesh(SIZE, walls), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 0 < mesh.volume < np.prod(mesh.extents)
    np.testing.assert_allclose(mesh.bounds[0], [*(-walls.outer_size(SIZE) / 2), -walls.thickness], atol=1e-12)
    np.testing.assert_allclose(mesh.bounds[1], [*(walls.outer_size(SIZE) / 2), SIZE[2]], atol=1e-12)


@given(shapes, st.integers(0, 1000))
def test_what_the_physics_lets_in_is_what_the_surface_leaves_free(walls: Walls, seed: int) -> None:
    points, normals = wall_planes(SIZE, walls)
    at = np.random.default_rng(seed).uniform([-0.2, -0.15, 0.001], [0.2, 0.15, 0.099], (200, 3))
    depth_in_wall = -np.einsum("pki,ki->pk", at[:, None] - points, normals).min(axis=1)
    # A ray straight down ends on the floor exactly where every half-space is kept at the floor; at its own height a
    # point between the walls sees the opening above.
    surface = BinSurface(SIZE, transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.0)), walls)
    for point in at[np.abs(depth_in_wall) > 1e-4][:20]:
        inside = -np.einsum("ki,ki->k", point - points, normals).min() < 0
        seen_from = BinSurface(SIZE, transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, point[2])), walls)
        floor = seen_from.moved(np.array([point[0], -point[1], 0.0])).depth(np.zeros((1, 2)))[0]
        lowest = np.array([*point[:2], 0.0])
        over_floor = (np.einsum("ki,ki->k", lowest - points, normals) > 1e-6).all()
        if over_floor:
            assert inside
            np.testing.assert_allclose(floor, point[2], atol=1e-6)
        elif inside:
            assert floor < point[2]  # the leaning wall comes first
    assert surface.walls is walls


@given(shapes, st.integers(0, 1000))
def test_the_walls_pieces_leave_the_inside_free_and_no_gap(walls: Walls, seed: int) -> None:
    pieces = [ConvexHull(piece).equations for piece in wall_pieces(SIZE, walls)]
    outer = walls.outer_size(SIZE) / 2
    at = np.random.default_rng(seed).uniform([*-outer, 0.0], [*outer, 0.12], (300, 3))
    in_a_piece = np.array([(at @ e[:, :3].T + e[:, 3] <= 0).all(axis=1) for e in pieces]).any(axis=0)
    points, normals = wall_planes(SIZE, walls)
    free = np.einsum("pki,ki->pk", at[:, None] - points, normals).min(axis=1)
    clear = (np.abs(free) > 1e-9) & (np.abs(at[:, 2] - SIZE[2]) > 1e-9)
    np.testing.assert_array_equal(in_a_piece[clear], ((free < 0) & (at[:, 2] < SIZE[2]))[clear])


def test_a_long_part_lies_on_the_rim() -> None:
    """Longer than the shallow bin, on its two short walls: it neither sinks through nor falls beside them."""
    bar = trimesh.creation.box([0.325, 0.01, 0.01])
    part = Part("bar", np.array(bar.vertices), np.array(bar.faces), 0.325)
    shallow, walls = np.array([0.30, 0.20, 0.03]), Walls(rim=0.02)
    model = drop._build_model(
        [Solid(part, (part.vertices,))], [mass_properties(part)], np.zeros(1, np.int32), shallow, 0.4, DropSettings(),
        walls,
    )  # fmt: skip
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0.05, 1, 0, 0, 0]
    model.body_gravcomp[1] = 0.0
    mujoco.mj_step(model, data, nstep=300)
    assert data.qpos[2] == pytest.approx(0.03 + 0.005, abs=0.001)  # half of its height above the rim


def test_corners_are_round_within_two_hundredths() -> None:
    walls = Walls(radius=0.02, draft_degrees=0)
    corner = np.array([0.13, 0.08])  # the arc's centre
    ring = bin_outlines(SIZE, walls)[0][:, :2]
    beyond = np.linalg.norm(ring - corner, axis=1)[(ring > corner - 1e-9).all(axis=1)]
    assert len(beyond) == 4
    assert beyond.min() >= 0.02 - 1e-12
    assert beyond.max() <= 0.02 * 1.02
    assert len(bin_outlines(SIZE, Walls(radius=0))[0]) == 4


@pytest.mark.parametrize("seed", range(4))
def test_rays_meet_walls_rim_and_floor_where_brute_force_does(slow: SimpleNamespace, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rotation_about((1, 0, 0), np.pi + rng.uniform(-0.9, 0.9)) @ rotation_about((0, 0, 1), rng.uniform(-3, 3))
    walls = Walls(thickness=0.01, rim=0.02, radius=0.03, draft_degrees=6)
    surface = BinSurface(SIZE, transform(turn, (*rng.uniform(-0.1, 0.1, 2), 0.6)), walls)
    vertices, faces = bin_mesh(SIZE, walls)
    triangles = apply(surface.camera_from_bin, vertices)[faces]
    xy = rng.uniform(-0.5, 0.5, (1500, 2))
    expected, _ = slow.cast(np.zeros(3), np.c_[xy, np.ones(len(xy))], triangles)
    depth = surface.depth(xy)
    assert 100 < np.isfinite(expected).sum() < 1500
    same = np.isfinite(expected) == np.isfinite(depth)
    assert same.mean() > 0.998
    both = same & np.isfinite(expected)
    np.testing.assert_allclose(depth[both], expected[both], atol=2e-6)
    assert surface.depth(np.zeros((0, 2))).shape == (0,)


def test_a_wall_casts_a_shadow(caster: PartCaster) -> None:
    """From beside the bin its wall hides the floor, from above it does not."""
    camera_from_bin = transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.5))
    surface = BinSurface(SIZE, camera_from_bin, Walls())
    poses = transform(np.eye(3), (0.0, 0.0, 0.3))[None]
    point = np.array([[-0.13, 0.05, 0.495]])
    aside = np.array([-0.4, 0.05, 0.2])
    assert not caster.blocked(poses, point, 5e-4, surface)[0]
    moved = poses.copy()
    moved[:, :3, 3] -= aside
    assert caster.blocked(moved, point - aside, 5e-4, surface.moved(aside))[0]


def test_a_part_beside_the_wall_is_hidden_by_the_rim(caster: PartCaster) -> None:
    camera_from_bin = transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.5))
    poses = transform(np.eye(3), (0.17, 0.0, 0.45))[None]  # outside, under the rim
    ray = np.array([[0.17 / 0.45, 0.0]])
    assert caster.cast(poses, ray, BinSurface(SIZE, camera_from_bin, Walls(rim=0.08))).instance[0] == -1
    assert caster.cast(poses, ray).instance[0] == 0


def piles(part: Part, hulls: Hulls, count: int, walls: Walls | None, **settings: object) -> list[NDArray]:
    ids, physics = np.zeros(count, dtype=np.int32), DropSettings(**settings)  # type: ignore[arg-type]
    size, rng = np.array([0.15, 0.12, 0.1]), np.random.default_rng(1)
    return list(drop_parts([Solid(part, hulls)], ids, size, 0.4, physics, rng, walls=walls))


def test_piles_lie_between_leaning_walls_and_round_corners(bracket: Part, hulls: Hulls) -> None:
    walls = Walls(radius=0.03, draft_degrees=10)
    points, normals = wall_planes(np.array([0.15, 0.12, 0.1]), walls)
    result = piles(bracket, hulls, 8, walls)
    assert len(result) == 8
    vertices = apply(result[-1], bracket.vertices).reshape(-1, 1, 3)
    assert np.einsum("pki,ki->pk", vertices - points, normals).min() > -0.005 * bracket.diameter
    assert vertices[..., 2].min() > -0.005 * bracket.diameter
    # Upright square walls keep them elsewhere.
    assert not np.allclose(result[-1], piles(bracket, hulls, 8, None)[-1], atol=1e-3)


def test_parts_fall_over_a_piece_of_the_floor(bracket: Part, hulls: Hulls) -> None:
    wide = [apply(p, bracket.vertices)[..., :2].reshape(-1, 2) for p in piles(bracket, hulls, 3, None)]
    heap = [
        apply(p, bracket.vertices)[..., :2].reshape(-1, 2) for p in piles(bracket, hulls, 3, None, area=(0.03, 0.03))
    ]
    assert np.ptp(heap[-1], axis=0).prod() < np.ptp(wide[-1], axis=0).prod()
    np.testing.assert_array_equal(
        piles(bracket, hulls, 1, None, area=(9.0, 9.0))[0][:, 2, 3] > 0, [True]
    )  # no larger than the bin


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Walls(thickness=0), "^thickness must be greater than 0 and at most 0.1; got 0"),
        (lambda: Walls(draft_degrees=40), "^draft_degrees must be at least 0 and at most 30; got 40"),
        (lambda: bin_mesh(SIZE, Walls(radius=0.11)), r"radius must be at most half of .* \(0.1 m\), got 0.11"),
        (
            lambda: bin_mesh(SIZE, Walls(rim_height=0.2)),
            r"rim_height must be at most the bin's height \(0.1 m\), got 0.2",
        ),
        (
            lambda: BinSettings((0.3, 0.2, 0.1), 0.1, Walls(radius=0.095)),
            r"^bin walls.radius must be at most half of .* \(0.09 m\), got 0.095",
        ),
        (lambda: DropSettings(area=(0.0, 0.1)), "^area must be .*greater than 0 and at most 100; got 0.0"),
    ],
)
def test_impossible_shapes(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
