"""The PPF baseline on real OpenCV: parts it must find, units, refusals, and the settings' ranges."""

from __future__ import annotations

import copy
import sys
from types import ModuleType

import numpy as np
import pytest
from standing_parts import errors, seen, standing

from attentionvote.baselines.opencv import surface_matching
from attentionvote.baselines.ppf import PpfDetector
from attentionvote.baselines.settings import PpfSettings
from attentionvote.part import Part
from attentionvote.simulation.part_files import load_part

COARSE = {"sampling": 0.08, "reference_step": 3, "hypotheses": 30}


@pytest.fixture(scope="module")
def part() -> Part:
    """Without symmetry of revolution, and not flat: 77 mm high on a foot of 60 x 96."""
    return load_part("slider_bearing_pedestal", "builtin:slider_bearing_pedestal")


@pytest.fixture(scope="module")
def voted(part: Part) -> PpfDetector:
    """Trained once."""
    return PpfDetector(part, PpfSettings(**COARSE, icp_iterations=0))


@pytest.fixture(scope="module")
def refined(voted: PpfDetector) -> PpfDetector:
    """The same training, with ICP behind it."""
    detector = copy.copy(voted)
    detector.settings = PpfSettings(**COARSE, score="fit")
    return detector


@pytest.mark.parametrize("count", [1, 3])
def test_parts_that_stand_apart_are_found_in_metres(part: Part, voted: PpfDetector, count: int) -> None:
    true = standing(part, count)
    found = voted.detect(*seen(part, true))
    best = found.camera_from_part[: 2 * count]
    offset, degrees = errors(part, best, true)
    # Metres: a result in millimetres, or relative to the scene's box, would be hundreds of diameters away.
    assert (offset < 0.10).all(), offset
    assert (degrees < 25).all(), degrees
    assert (np.diff(found.scores) <= 0).all()
    rotations = found.camera_from_part[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2) - np.eye(3), 0, atol=1e-9)
    assert (np.linalg.det(rotations) > 0).all()


def test_icp_brings_poses_nearer_and_fit_ranks_them_first(part: Part, voted: PpfDetector, refined: PpfDetector) -> None:
    true = standing(part, 3)
    cloud = seen(part, true)
    coarse, fine = voted.detect(*cloud), refined.detect(*cloud)
    before, after = (errors(part, found.camera_from_part, true) for found in (coarse, fine))
    assert (after[0] < 0.02).all()
    assert (after[1] < 2).all()
    assert after[0].mean() < 0.5 * before[0].mean()
    offset, _ = errors(part, fine.camera_from_part[:3], true)  # the three best are the three parts
    assert (offset < 0.02).all()
    assert (fine.scores[:3] > 0.3).all()
    assert (fine.scores <= 1).all()


def test_the_unit_does_not_matter_but_through_the_part(part: Part) -> None:
    # Ten times the part in ten times the scene: OpenCV's own merging would depend on it.
    points, normals = seen(part, standing(part, 1))
    large = Part("large", 10 * part.vertices, part.faces, 10 * part.diameter, part.symmetry)
    settings = PpfSettings(sampling=0.12, reference_step=2, icp_iterations=0)
    found = PpfDetector(part, settings).detect(points, normals)
    tenfold = PpfDetector(large, settings).detect(10 * points, normals)
    np.testing.assert_allclose(
        tenfold.camera_from_part[0, :3, 3], 10 * found.camera_from_part[0, :3, 3], atol=0.02 * large.diameter
    )
    assert abs(len(tenfold.scores) - len(found.scores)) <= 0.1 * len(found.scores)


def test_a_plane_at_right_angles_to_an_axis_is_searched_without_a_crash(voted: PpfDetector) -> None:
    u, v = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60))
    wall = np.stack([u.ravel(), v.ravel(), np.full(u.size, 0.8)], axis=1).astype(np.float32)
    found = voted.detect(wall, np.tile(np.float32([0, 0, -1]), (len(wall), 1)))
    assert np.isfinite(found.camera_from_part).all()


def test_a_cloud_of_a_few_points_holds_nothing(voted: PpfDetector) -> None:
    for count in (0, 1, 20):
        points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
        found = voted.detect(points, np.tile(np.float32([0, 0, -1]), (count, 1)))
        assert found.camera_from_part.shape == (0, 4, 4)
        assert found.scores.shape == (0,)
    same = np.zeros((100, 3), np.float32)
    assert len(voted.detect(same, np.tile(np.float32([0, 0, -1]), (100, 1))).scores) == 0


@pytest.mark.parametrize(
    ("points", "normals", "sentence"),
    [
        (np.zeros((50, 3)), None, "need a normal at every point, got none: estimate them with geometry.pointcloud"),
        (np.zeros((50, 3)), np.zeros((40, 3)), r"must both have shape \(P, 3\), got \(50, 3\) and \(40, 3\)"),
        (np.full((50, 3), np.nan), np.tile([0, 0, 1.0], (50, 1)), "must be finite, got 50 points with NaN or inf"),
        (np.zeros((50, 3)), np.zeros((50, 3)), "normals must be unit vectors, got lengths 0..0"),
    ],
)
def test_what_cannot_be_searched_is_one_sentence(
    voted: PpfDetector, points: np.ndarray, normals: np.ndarray | None, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        voted.detect(points, normals)


def test_a_missing_opencv_names_the_extra(monkeypatch: pytest.MonkeyPatch, part: Part) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match=r"cv2 is missing: run `make setup`, or .*pip install '\.\[benchmark\]'"):
        PpfDetector(part)
    plain = ModuleType("cv2")
    plain.__version__ = "4.9"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cv2", plain)
    with pytest.raises(ValueError, match=r"OpenCV 4.9 here is built without it .*\[benchmark\]"):
        surface_matching()


def test_opencv_keeps_its_threads(voted: PpfDetector, part: Part) -> None:
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        voted.detect(*seen(part, standing(part, 1)))
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sampling": 0.001}, "^sampling must be at least 0.02 and at most 0.2; got 0.001"),
        ({"hypotheses": 0}, "^hypotheses must be at least 1 and at most 10000; got 0"),
        ({"fit_distance": float("nan")}, "^fit_distance must be at least 0.001 and at most 0.5; got nan"),
        ({"score": "vote"}, "^score must be one of votes, fit; got 'vote', did you mean 'votes'"),
    ],
)
def test_impossible_settings_are_one_sentence(change: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        PpfSettings(**change)
