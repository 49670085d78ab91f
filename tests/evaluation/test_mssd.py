"""MSSD against its definition, vertex by vertex and symmetry by symmetry, and against cases known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation.mssd import CONTINUOUS_STEPS, SurfaceDistance, symmetry_transforms
from attentionvote.geometry.pose import apply, rotation_about, transform

FLIP = transform(rotation_about((1, 0, 0), np.pi), [0.0, 0.004, 0.006])
AXIS = ((0.0, 0.0, 2.0), (0.01, -0.02, 0.0))
SYMMETRIES = {
    "none": symmetry_transforms(),
    "discrete": symmetry_transforms([FLIP]),
    "continuous": symmetry_transforms((), [AXIS]),
    "both": symmetry_transforms([FLIP], [AXIS]),
}


def cloud(seed: int = 0, count: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.02, 0.02, 0.05] + [0.003, 0, 0.01]


def slow(points: np.ndarray, symmetries: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """One pair by the definition."""
    return min(max(np.linalg.norm(apply(a, points) - apply(b @ s, points), axis=1)) for s in symmetries)


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_are_those_of_the_definition(name, make_poses, seed):
    rng = np.random.default_rng(seed)
    symmetries, points = SYMMETRIES[name], cloud(seed % 7)
    b = make_poses(rng, 2, 0.05)
    near = b[0] @ symmetries[rng.integers(len(symmetries))] @ transform(rotation_about((1, 2, 3), 0.05), [0.002, 0, 0])
    a = np.concatenate([make_poses(rng, 2, 0.05), near[None]])
    expected = [[slow(points, symmetries, p, q) for q in b] for p in a]
    np.testing.assert_allclose(SurfaceDistance(points, symmetries).distances(a, b), expected, atol=1e-13)


def test_a_translation_is_its_length_and_a_turn_moves_the_farthest_vertex():
    # A rod from -3 to 5 cm along x: turned by 60 degrees about z, its far end moves by 5 cm * 2 sin(30) = 5 cm.
    rod = SurfaceDistance([[-0.03, 0, 0], [0.01, 0, 0], [0.05, 0, 0]])
    moved = transform(np.eye(3), [[0.003, 0, 0.004]])
    turned = transform(rotation_about((0, 0, 1), np.pi / 3), [[0, 0, 0]])
    assert rod.distances(moved, np.eye(4))[0, 0] == pytest.approx(0.005)
    assert rod.distances(turned, np.eye(4))[0, 0] == pytest.approx(0.05)


def test_a_symmetry_acts_on_the_part_before_its_pose():
    # Turned over about x through (0, 2 mm, 3 mm): without it the vertex 20 mm up would be far off.
    points = np.array([[0.01, 0.002, 0.003], [0, 0.002, 0.02]])
    pose = transform(rotation_about((0, 1, 0), 0.7), [0.1, 0.2, 0.9])
    assert SurfaceDistance(points, SYMMETRIES["discrete"]).distances(pose @ FLIP, pose)[0, 0] < 1e-15
    assert SurfaceDistance(points).distances(pose @ FLIP, pose)[0, 0] > 0.03


def test_continuous_symmetries_are_315_turns_about_the_axis_composed_with_the_discrete_ones():
    turns = SYMMETRIES["continuous"]
    assert len(turns) == CONTINUOUS_STEPS == np.ceil(np.pi / 0.01) == 315
    np.testing.assert_allclose(turns[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(turns[1][:3, :3], rotation_about((0, 0, 1), 2 * np.pi / 315), atol=1e-15)
    on_axis = np.array([0.01, -0.02, 0.7, 1.0])
    np.testing.assert_allclose(turns @ on_axis, np.tile(on_axis, (315, 1)), atol=1e-15)
    both = SYMMETRIES["both"]
    assert len(both) == 2 * 315
    np.testing.assert_allclose(both[315:], turns @ FLIP, atol=1e-15)
    assert len(symmetry_transforms((), [AXIS, ((1, 0, 0), (0, 0, 0))])) == 2 * 315
    assert len(SYMMETRIES["discrete"]) == 2


def test_between_two_steps_a_round_part_is_off_by_half_a_step():
    # A vertex 30 mm from the axis, half a step away from the nearest turn: 30 mm * 2 sin(pi / 315 / 2).
    round_part = SurfaceDistance([[0.03, 0, 0], [0, 0, 0.01]], symmetry_transforms((), [((0, 0, 1), (0, 0, 0))]))
    half_way = transform(rotation_about((0, 0, 1), 7.5 * 2 * np.pi / 315), np.zeros(3))
    got = round_part.distances(half_way, np.eye(4))[0, 0]
    assert got == pytest.approx(0.03 * 2 * np.sin(np.pi / 630), rel=1e-9)


def test_origins_a_diameter_apart_are_out_of_reach():
    near, far = (transform(np.eye(3), [[x, 0, 0]]) for x in (0.0999, 0.1))
    distance = SurfaceDistance(cloud(), reach=0.1)
    assert distance.distances(near, np.eye(4))[0, 0] == pytest.approx(0.0999)
    assert distance.distances(far, np.eye(4))[0, 0] == np.inf


def test_flat_and_empty_models_and_no_pose(make_poses):
    rng = np.random.default_rng(1)
    flat = cloud() * [1, 1, 0]
    a, b = make_poses(rng, 2, 0.05), make_poses(rng, 3, 0.05)
    expected = [[slow(flat, np.eye(4)[None], p, q) for q in b] for p in a]
    np.testing.assert_allclose(SurfaceDistance(flat).distances(a, b), expected, atol=1e-13)
    assert SurfaceDistance(cloud()).distances(np.zeros((0, 4, 4)), b).shape == (0, 3)
    with pytest.raises(ValueError, match="a model must have finite vertices, at least one, got 0"):
        SurfaceDistance(np.zeros((0, 3)))
