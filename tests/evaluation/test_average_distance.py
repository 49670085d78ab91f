"""ADD and ADD-S against their definitions, pair by pair and point by point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation import SceneResult, average_distance, match
from attentionvote.evaluation.average_distance import AverageDistance, NearestPointDistance
from attentionvote.geometry.pose import apply, rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry

FINITE = {
    "none": Symmetry(),
    "cyclic": Symmetry("cyclic", order=3, axis=(1.0, 1.0, 0.0)),
    "dihedral": Symmetry("dihedral", order=2),
}


def cloud(seed: int = 0, count: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.02, 0.02, 0.05] + [0, 0, 0.01]


def slow_add(points, a, b, turns) -> np.ndarray:
    return np.array(
        [
            [min(np.linalg.norm(apply(p, points) - apply(q, points @ t.T), axis=1).mean() for t in turns) for q in b]
            for p in a
        ]
    )


@pytest.mark.parametrize("name", FINITE)
def test_add_is_the_least_mean_distance_over_the_group(name, make_poses):
    rng = np.random.default_rng(1)
    a, b, points = make_poses(rng, 4), make_poses(rng, 5), cloud()
    got = AverageDistance(points, FINITE[name]).distances(a, b)
    np.testing.assert_allclose(got, slow_add(points, a, b, FINITE[name].rotations()), atol=1e-14)


@pytest.mark.parametrize("flip", [False, True])
def test_add_of_revolution_is_within_a_per_cent_of_the_enumerated_minimum(flip, make_poses):
    symmetry = Symmetry("revolution", axis=(1.0, 0.5, 2.0), flip=flip)
    rng = np.random.default_rng(2)
    points, b = cloud(count=200) @ symmetry.frame().T, make_poses(rng, 12)  # round about the axis, up to sampling
    near = transform(rotation_about((0.3, -0.8, 0.4), rng.normal(size=12) * 0.2), rng.normal(size=(12, 3)) * 0.005)
    half = symmetry.rotations()[-1]
    spin = rotation_about(symmetry.axis, rng.uniform(0, 6, 12)) @ half
    a = b @ near @ transform(spin, np.zeros(3))
    turns = [r @ rotation_about(symmetry.axis, t) for r in symmetry.rotations() for t in np.arange(0, 2 * np.pi, 0.02)]
    got = np.diagonal(AverageDistance(points, symmetry).distances(a, b))
    best = np.array([slow_add(points, a[[i]], b[[i]], turns)[0, 0] for i in range(12)])
    # From below by the steps of the enumeration, from above by using the best squared distance.
    assert (got < 1.01 * best).all()
    assert (got > best - 0.01 * 0.02).all()


def test_add_of_a_body_of_revolution_is_zero_after_any_turn(make_poses):
    symmetry = Symmetry("revolution", flip=True)
    pose = make_poses(np.random.default_rng(3), 1)
    turned = pose @ transform(rotation_about((0, 0, 1), 1.234) @ symmetry.rotations()[1], np.zeros(3))
    assert AverageDistance(cloud(), symmetry).distances(turned, pose)[0, 0] < 1e-15


def test_add_of_a_translation_is_its_length():
    moved = transform(np.eye(3), [[0.003, 0, 0.004]])
    assert AverageDistance(cloud(), Symmetry()).distances(moved, np.eye(4)[None])[0, 0] == pytest.approx(0.005)


def test_add_s_is_the_mean_distance_to_the_nearest_point(make_poses):
    rng = np.random.default_rng(4)
    a, b, points = make_poses(rng, 3, 0.05), make_poses(rng, 4, 0.05), cloud()
    slow = np.zeros((3, 4))
    for i, p in enumerate(a):
        for j, q in enumerate(b):
            pairs = np.linalg.norm(apply(p, points)[None] - apply(q, points)[:, None], axis=-1)
            slow[i, j] = pairs.min(1).mean()
    np.testing.assert_allclose(NearestPointDistance(points).distances(a, b), slow, atol=1e-14)


@pytest.mark.parametrize(
    "distance",
    [
        *(AverageDistance(cloud(), symmetry, 0.05) for symmetry in FINITE.values()),
        AverageDistance(cloud(), Symmetry("revolution", flip=True), 0.05),
        NearestPointDistance(cloud(), 0.05),
    ],
    ids=[*FINITE, "revolution", "nearest point"],
)
def test_limit_changes_no_distance_below_it_and_no_matching(distance, make_poses):
    rng = np.random.default_rng(5)
    b = make_poses(rng, 12, 0.15)
    turn = rotation_about((1, 0, 0), rng.normal(size=30) * 0.3)
    a = b[rng.integers(0, 12, 30)] @ transform(turn, rng.normal(size=(30, 3)) * 0.02)
    exact = type(distance)(**{**vars(distance), "limit": np.inf}).distances(a, b)
    got = distance.distances(a, b)
    near = exact <= 0.05
    assert 0 < near.sum() < near.size
    np.testing.assert_array_equal(got[near], exact[near])
    assert (got[~near] > 0.05).all()
    assert (got <= exact + 1e-15).all()
    scores, to_find = rng.random(30), np.ones(12, dtype=bool)
    one, other = (match(d, scores, to_find, 0.05) for d in (got, exact))
    assert one.pairs.tolist() == other.pairs.tolist()
    assert one.duplicates.tolist() == other.duplicates.tolist()


def test_blocks_do_not_change_the_result(make_poses, monkeypatch):
    rng = np.random.default_rng(6)
    a, b = make_poses(rng, 5), make_poses(rng, 6)
    for distance in (AverageDistance(cloud(), FINITE["cyclic"]), NearestPointDistance(cloud())):
        whole = distance.distances(a, b)
        with monkeypatch.context() as patch:
            patch.setattr(average_distance, "BLOCK_VALUES", 500)
            np.testing.assert_allclose(distance.distances(a, b), whole, atol=1e-15)


@pytest.mark.parametrize("results, truths", [(0, 3), (3, 0), (0, 0)])  # noqa: PT006
def test_distances_of_no_pose_are_an_empty_table(results, truths, make_poses):
    rng = np.random.default_rng(7)
    scene = SceneResult(make_poses(rng, results), np.ones(results), make_poses(rng, truths), np.ones(truths))
    for distance in (AverageDistance(cloud(), Symmetry()), NearestPointDistance(cloud())):
        assert distance.distances(scene.poses, scene.gt_poses).shape == (results, truths)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_add_s_is_never_above_add_and_both_ignore_a_common_motion(box, make_poses, seed):
    part = box(Symmetry("cyclic", order=2))
    rng = np.random.default_rng(seed)
    a, b, motion = make_poses(rng, 2, 0.05), make_poses(rng, 2, 0.05), make_poses(rng, 1)[0]
    add, add_s = AverageDistance.of(part), NearestPointDistance.of(part)
    literal = AverageDistance(add.points, Symmetry())
    np.testing.assert_allclose(add.distances(motion @ a, motion @ b), add.distances(a, b), atol=1e-12)
    np.testing.assert_allclose(add_s.distances(motion @ a, motion @ b), add_s.distances(a, b), atol=1e-12)
    assert (add_s.distances(a, b) <= literal.distances(a, b) + 1e-12).all()
    assert (add.distances(a, b) <= literal.distances(a, b) + 1e-12).all()
