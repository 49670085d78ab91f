"""The FPFH baseline on real Open3D: parts it must find, the same answer twice, refusals, and the settings' ranges."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from standing_parts import errors, seen, standing

from attentionvote.baselines.clouds import Detections
from attentionvote.baselines.fpfh import FpfhDetector
from attentionvote.baselines.open3d import open3d_version, registration, threads
from attentionvote.baselines.settings import FpfhSettings
from attentionvote.part import Part
from attentionvote.simulation.part_files import load_part

QUICK = FpfhSettings(sampling=0.05, reference_step=8, iterations=5000, hypotheses=40)


@pytest.fixture(scope="module")
def part() -> Part:
    """Without symmetry of revolution, and not flat: 77 mm high on a foot of 60 x 96."""
    return load_part("slider_bearing_pedestal", "builtin:slider_bearing_pedestal")


@pytest.fixture(scope="module")
def detector(part: Part) -> FpfhDetector:
    """Made once."""
    return FpfhDetector(part, QUICK)


@pytest.fixture(scope="module")
def found(detector: FpfhDetector, cloud: tuple[np.ndarray, np.ndarray]) -> Detections:
    """In it."""
    return detector.detect(*cloud)


@pytest.fixture(scope="module")
def cloud(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Of three parts."""
    return seen(part, standing(part, 3))


def test_the_best_three_poses_are_the_three_parts(part: Part, found: Detections) -> None:
    offset, degrees = errors(part, found.camera_from_part[:3], standing(part, 3))
    assert (offset < 0.02).all(), offset
    assert (degrees < 3).all(), degrees
    assert (found.scores[:3] > 0.3).all()
    assert (np.diff(found.scores) <= 0).all()
    assert (found.scores <= 1).all()
    rotations = found.camera_from_part[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2) - np.eye(3), 0, atol=1e-9)
    assert (np.linalg.det(rotations) > 0).all()


def test_icp_brings_poses_nearer(part: Part, detector: FpfhDetector, cloud: tuple[np.ndarray, np.ndarray]) -> None:
    true = standing(part, 3)
    whole = np.concatenate(cloud, axis=1)
    turned = true.copy()
    turned[:, :3, 3] += 0.02 * part.diameter
    offset, degrees = errors(part, detector.refined(turned, whole), true)
    assert (offset < 0.005).all(), offset
    assert (degrees < 1).all(), degrees
    # Nothing is near: the pose stays where it was.
    far = true[:1] + np.array([[0, 0, 0, 3.0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_array_equal(detector.refined(far, whole), far)


def test_another_detector_answers_the_same_to_the_bit(
    part: Part, found: Detections, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    registration().utility.random.seed(99)  # as if others had drawn before
    again = FpfhDetector(part, QUICK).detect(*cloud)
    assert len(found.scores) > 3
    np.testing.assert_array_equal(found.camera_from_part, again.camera_from_part)
    np.testing.assert_array_equal(found.scores, again.scores)


def test_ten_times_the_part_in_ten_times_the_scene_is_the_same_search(part: Part) -> None:
    points, normals = seen(part, standing(part, 1))
    large = Part("large", 10 * part.vertices, part.faces, 10 * part.diameter, part.symmetry)
    found = FpfhDetector(part, QUICK).detect(points, normals)
    tenfold = FpfhDetector(large, QUICK).detect(10 * points, normals)
    np.testing.assert_allclose(
        tenfold.camera_from_part[0, :3, 3], 10 * found.camera_from_part[0, :3, 3], atol=0.005 * large.diameter
    )
    assert tenfold.scores[0] == pytest.approx(found.scores[0], abs=0.05)


def test_a_cloud_of_a_few_points_holds_nothing(detector: FpfhDetector) -> None:
    for count in (0, 1, 20):
        points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
        found = detector.detect(points, np.tile(np.float32([0, 0, -1]), (count, 1)))
        assert found.camera_from_part.shape == (0, 4, 4)
        assert found.scores.shape == (0,)
    same = np.zeros((100, 3), np.float32)
    assert len(detector.detect(same, np.tile(np.float32([0, 0, -1]), (100, 1))).scores) == 0


def test_points_that_lie_far_apart_hold_nothing(part: Part, detector: FpfhDetector) -> None:
    points = np.stack(np.meshgrid(*[np.arange(5) * part.diameter] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    found = detector.detect(points, np.tile(np.float32([0, 0, -1]), (len(points), 1)))
    assert found.camera_from_part.shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("points", "normals", "sentence"),
    [
        (np.zeros((50, 3)), None, "histograms need a normal at every point, got none: estimate them with geometry"),
        (np.zeros((50, 3)), np.zeros((40, 3)), r"must both have shape \(P, 3\), got \(50, 3\) and \(40, 3\)"),
        (np.full((50, 3), np.nan), np.tile([0, 0, 1.0], (50, 1)), "must be finite, got 50 points with NaN or inf"),
        (np.zeros((50, 3)), np.zeros((50, 3)), "normals must be unit vectors, got lengths 0..0"),
    ],
)
def test_what_cannot_be_searched_is_one_sentence(
    detector: FpfhDetector, points: np.ndarray, normals: np.ndarray | None, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        detector.detect(points, normals)


def test_a_missing_open3d_names_the_extra(monkeypatch: pytest.MonkeyPatch, part: Part) -> None:
    assert registration().__version__.startswith(open3d_version())
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(
        ValueError, match=r"FPFH baseline needs open3d, .* run `make setup`, .*pip install '\.\[train\]'"
    ):
        FpfhDetector(part)


def test_open3d_keeps_its_threads(detector: FpfhDetector, cloud: tuple[np.ndarray, np.ndarray]) -> None:
    module = registration()
    before = module.utility.get_max_threads()
    with threads(module, 2):
        detector.detect(cloud[0][:200], cloud[1][:200])
        assert module.utility.get_max_threads() == 2
    assert module.utility.get_max_threads() == before


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sampling": 0.001}, "^sampling must be at least 0.02 and at most 0.2; got 0.001"),
        ({"hypotheses": 0}, "^hypotheses must be at least 1 and at most 10000; got 0"),
        ({"feature_radius": float("nan")}, "^feature_radius must be at least 0.04 and at most 1; got nan"),
        ({"views": 3}, "^views must be at least 4 and at most 200; got 3"),
    ],
)
def test_impossible_settings_are_one_sentence(change: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        FpfhSettings(**change)
