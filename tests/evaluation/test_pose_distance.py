"""The pose distance against first principles: the root mean square displacement of the surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation import PoseMetric, rotation_errors
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import surface_moments

SYMMETRIES = {
    "none": Symmetry(),
    "cyclic": Symmetry("cyclic", order=2),
    "dihedral": Symmetry("dihedral", order=2),
    "revolution": Symmetry("revolution"),
    "revolution about a tilted axis": Symmetry("revolution", axis=(1.0, 2.0, -0.5)),
    "revolution with flip": Symmetry("revolution", axis=(0.0, 1.0, 0.0), flip=True),
}


def symmetric_root(symmetry: Symmetry) -> np.ndarray:
    """A covariance root that the symmetry leaves alone: axial in the frame of the axis."""
    across = 0.02 if symmetry.is_revolution else 0.013
    frame = symmetry.frame() if symmetry.is_revolution else np.eye(3)
    return frame @ np.diag([0.02, across, 0.04]) @ frame.T


def element(symmetry: Symmetry, index: int, angle: float) -> np.ndarray:
    turns = symmetry.rotations()
    turn = turns[index % len(turns)]
    return turn @ rotation_about(symmetry.axis, angle) if symmetry.is_revolution else turn


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), index=st.integers(0, 7), angle=st.floats(-4, 4))
def test_distance_is_invariant_under_relabelling_and_a_common_motion(name, make_poses, seed, index, angle):
    symmetry = SYMMETRIES[name]
    metric = PoseMetric(symmetry, symmetric_root(symmetry))
    rng = np.random.default_rng(seed)
    a, b, motion = make_poses(rng, 3), make_poses(rng, 4), make_poses(rng, 1)[0]
    expected = metric.distances(a, b)
    relabel = transform(element(symmetry, index, angle), np.zeros(3))
    np.testing.assert_allclose(metric.distances(a, b @ relabel), expected, atol=1e-12)
    np.testing.assert_allclose(metric.distances(a @ relabel, b), expected, atol=1e-12)
    np.testing.assert_allclose(metric.distances(motion @ a, motion @ b), expected, atol=1e-12)
    np.testing.assert_allclose(metric.distances(b, a).T, expected, atol=1e-12)
    # Zero up to the root of the rounding error of a turned representative.
    np.testing.assert_allclose(np.diagonal(metric.distances(a, a @ relabel)), 0, atol=1e-12)


@pytest.mark.parametrize("at_centroid", [True, False])
def test_distance_is_the_rms_displacement_of_the_surface(box, make_poses, at_centroid):
    part = box()
    rng = np.random.default_rng(1)
    a, b = make_poses(rng, 2), make_poses(rng, 3)
    points = part.surface_points(200_000, rng)
    moved = [[(p[:3, :3] - q[:3, :3]) @ points.T + (p - q)[:3, 3:] for q in b] for p in a]
    rms = [[np.sqrt((d**2).sum(0).mean()) for d in row] for row in moved]
    # 200,000 points reproduce the second moments to about 0.3 %.
    np.testing.assert_allclose(PoseMetric.of(part, at_centroid).distances(a, b), rms, rtol=5e-3)


def test_distance_at_centroid_compares_the_centroid(box, make_poses):
    part = box()
    shifted = type(part)("shifted", part.vertices + np.array([0.01, 0.02, -0.03]), part.faces, part.diameter)
    rng = np.random.default_rng(2)
    a, b = make_poses(rng, 3), make_poses(rng, 3)
    move = transform(np.eye(3), surface_moments(shifted.vertices, shifted.faces)[1])
    expected = PoseMetric.of(part).distances(a @ move, b @ move)
    np.testing.assert_allclose(PoseMetric.of(shifted, at_centroid=True).distances(a, b), expected, atol=1e-12)
    assert np.abs(PoseMetric.of(shifted).distances(a, b) - expected).max() > 1e-3


def test_distance_takes_the_least_over_the_group(make_poses):
    symmetry = SYMMETRIES["dihedral"]
    root = symmetric_root(symmetry)
    rng = np.random.default_rng(3)
    a, b = make_poses(rng, 4), make_poses(rng, 5)
    slow = np.full((4, 5), np.inf)
    for i, p in enumerate(a):
        for j, q in enumerate(b):
            for turn in symmetry.rotations():
                rotation = ((p[:3, :3] - q[:3, :3] @ turn) @ root) ** 2
                slow[i, j] = min(slow[i, j], np.sqrt(rotation.sum() + ((p - q)[:3, 3] ** 2).sum()))
    np.testing.assert_allclose(PoseMetric(symmetry, root).distances(a, b), slow, atol=1e-13)


def test_distance_of_revolution_is_the_least_over_enumerated_turns_for_small_tilts():
    # Near agreement both forms are lambda times the tilt to first order.
    symmetry = SYMMETRIES["revolution"]
    metric = PoseMetric(symmetry, symmetric_root(symmetry))
    finite = PoseMetric(Symmetry("cyclic", order=720), metric.covariance_root)
    tilted = transform(rotation_about((0.6, 0.8, 0), 0.01), [0.001, 0, 0])[None]
    np.testing.assert_allclose(
        metric.distances(tilted, np.eye(4)[None]), finite.distances(tilted, np.eye(4)[None]), rtol=1e-4
    )


def test_distance_of_a_turned_over_body_depends_on_flip():
    over = transform(rotation_about((1, 0, 0), np.pi), np.zeros(3))[None]
    root, identity = np.diag([0.03, 0.03, 0.04]), np.eye(4)[None]
    assert PoseMetric(Symmetry("revolution"), root).distances(over, identity)[0, 0] == pytest.approx(0.1)
    assert PoseMetric(Symmetry("revolution", flip=True), root).distances(over, identity)[0, 0] < 1e-15


def test_distances_of_no_pose_are_an_empty_table(make_poses):
    poses = make_poses(np.random.default_rng(0), 3)
    for symmetry in SYMMETRIES.values():
        metric = PoseMetric(symmetry, np.eye(3))
        assert metric.distances(np.zeros((0, 4, 4)), poses).shape == (0, 3)
        assert metric.distances(poses, np.zeros((0, 4, 4))).shape == (3, 0)


def test_rotation_errors_respect_the_symmetry():
    a = transform(rotation_about((0, 0, 1), np.radians([0, 0, 0])), np.zeros(3))
    b = np.stack([transform(rotation_about(u, np.radians(v)), [1, 2, 3]) for u, v in [
        ((0, 0, 1), 170.0), ((1, 0, 0), 170.0), ((1, 0, 0), 1e-5)]])  # fmt: skip
    expected = {
        "none": [170, 170, 1e-5],
        "cyclic": [10, 170, 1e-5],
        "dihedral": [10, 10, 1e-5],
        "revolution": [0, 170, 1e-5],
    }
    for name, degrees in expected.items():
        np.testing.assert_allclose(np.degrees(rotation_errors(a, b, SYMMETRIES[name])), degrees, atol=1e-9)
    flip = Symmetry("revolution", flip=True)
    np.testing.assert_allclose(np.degrees(rotation_errors(a, b, flip)), [0, 10, 1e-5], atol=1e-9)


def test_metric_refuses_a_wrong_covariance():
    with pytest.raises(ValueError, match=r"covariance_root must be \(3, 3\) finite numbers, got shape \(3,\)"):
        PoseMetric(Symmetry(), np.ones(3))
