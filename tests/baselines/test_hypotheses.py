"""Merging, suppression and fit of hypotheses, on poses whose answer is known."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from attentionvote.baselines.hypotheses import apart, fits, merged, placed
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry

CENTER = np.array([0.02, 0.0, 0.0])  # not the origin: a turn about the origin moves it


def turned(degrees: float, place: tuple[float, float, float]) -> np.ndarray:
    """A pose turned about z whose part has its centre at ``place``."""
    rotation = rotation_about([0, 0, 1], np.radians(degrees))
    return transform(rotation, np.asarray(place) - rotation @ CENTER)


def test_votes_of_similar_poses_are_added_and_the_best_one_stays() -> None:
    poses = np.stack([turned(0, (0, 0, 1)), turned(20, (0.004, 0, 1)), turned(40, (0, 0, 1)), turned(5, (0.1, 0, 1))])
    votes = np.array([3.0, 5.0, 2.0, 9.0])
    found, totals = merged(poses, votes, CENTER, Symmetry(), 0.01, np.radians(25))
    np.testing.assert_array_equal(totals, [10, 9])
    np.testing.assert_array_equal(found, poses[[1, 3]])


def test_poses_that_a_symmetry_makes_equal_are_similar() -> None:
    poses = np.stack([turned(0, (0, 0, 1)), turned(183, (0, 0, 1)), turned(90, (0, 0, 1))])
    votes = np.array([2.0, 1.0, 1.5])
    half_turn = Symmetry("cyclic", order=2)
    assert merged(poses, votes, CENTER, Symmetry(), 0.01, 0.2)[1].tolist() == [2, 1.5, 1]
    assert merged(poses, votes, CENTER, half_turn, 0.01, 0.2)[1].tolist() == [3, 1.5]
    assert merged(poses, votes, CENTER, Symmetry("revolution"), 0.01, 0.2)[1].tolist() == [4.5]


@given(st.integers(0, 10_000), st.integers(0, 12))
def test_merging_loses_no_vote_and_keeps_no_two_similar_poses(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.array([turned(a, (x, 0, 1)) for a, x in rng.uniform((0, 0), (360, 0.05), (count, 2))]).reshape(-1, 4, 4)
    votes = rng.integers(1, 50, count).astype(float)
    found, totals = merged(poses, votes, CENTER, Symmetry(), 0.01, 0.5)
    assert totals.sum() == votes.sum()
    assert (np.diff(totals) <= 0).all()
    centers = found[:, :3, :3] @ CENTER + found[:, :3, 3]
    for i in range(len(found)):
        near = np.linalg.norm(centers - centers[i], axis=1) <= 0.01
        similar = near & (Symmetry().angle(found[:, :3, :3], found[i, :3, :3]) <= 0.5)
        assert similar.sum() == 1


@given(st.integers(0, 10_000), st.integers(0, 15))
def test_what_is_kept_lies_apart_and_what_is_not_has_a_better_one_near(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 0.1, (count, 3))
    poses = np.array([turned(0, tuple(place)) for place in places]).reshape(-1, 4, 4)
    scores = rng.random(count)
    kept = apart(poses, scores, CENTER, 0.03)
    assert (np.diff(scores[kept]) <= 0).all()
    distance = np.linalg.norm(places[:, None] - places, axis=-1)
    for i in range(count):
        better = [k for k in kept if scores[k] > scores[i] and distance[i, k] <= 0.03]
        assert (i in kept) == (not better)


def test_fit_is_the_share_of_the_visible_side_that_was_measured() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-0.02, 0.02, 21), np.linspace(-0.02, 0.02, 21)), -1).reshape(-1, 2)
    front = np.c_[grid, np.full(441, -0.01), np.tile([0, 0, -1], (441, 1))]
    back = np.c_[grid, np.full(441, 0.01), np.tile([0, 0, 1], (441, 1))]
    model = np.concatenate([front, back]).astype(np.float32)
    pose = transform(np.eye(3), [0, 0, 0.5])
    assert len(placed(model, pose)) == 441  # the back is hidden
    measured = front[:, :3] + [0, 0, 0.5]
    whole, half = cKDTree(measured), cKDTree(measured[measured[:, 0] > 0.0005])
    np.testing.assert_allclose(fits(pose[None], model, whole, 0.001), [1])
    np.testing.assert_allclose(fits(pose[None], model, half, 0.001), [10 / 21])
    away = transform(np.eye(3), [0, 0, 0.503])
    np.testing.assert_allclose(fits(np.stack([away, pose]), model, whole, 0.001), [0, 1])
    assert fits(np.zeros((0, 4, 4)), model, whole, 0.001).shape == (0,)
