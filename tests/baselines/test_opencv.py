"""OpenCV's surface matching as it is: what the baseline's docstring says of it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from attentionvote.baselines.clouds import thinned
from attentionvote.baselines.opencv import surface_matching, threads
from attentionvote.part import Part


@pytest.fixture(scope="module")
def cloud(box: Part) -> np.ndarray:
    """The surface of a box of 60 x 40 x 20 mm with its normals, in metres."""
    sides = []
    rng = np.random.default_rng(2)
    half = np.array([0.03, 0.02, 0.01])
    for axis in range(3):
        for sign in (-1, 1):
            points = rng.uniform(-half, half, (600, 3))
            points[:, axis] = sign * half[axis]
            sides.append(np.c_[points, np.tile(sign * np.eye(3)[axis], (600, 1))])
    return thinned(np.concatenate(sides).astype(np.float32), 0.1 * box.diameter)


def matched(cloud: np.ndarray, unit: float, distance_step: float = 0.12) -> list:
    """OpenCV's answer for the box in itself, with metres times ``unit``."""
    scaled = cloud.copy()
    scaled[:, :3] *= unit
    detector = cv2.ppf_match_3d.PPF3DDetector(0.12, distance_step, 30)
    detector.trainModel(scaled)
    return list(detector.match(scaled, 1 / 2.5, 1 / 15.5))


def test_its_merging_depends_on_the_unit_and_takes_a_whole_part_for_one_pose(cloud: np.ndarray) -> None:
    metres, fine = matched(cloud, 1.0), matched(cloud, 1e5)
    references = len(cloud) // 2
    assert len(metres) == 1  # 0.12 units are 12 cm: every pose, whatever its rotation
    assert len(fine) > 0.5 * references  # 1.2 micrometres: nearly every reference point keeps its own
    # The votes are the same ones, but for cells that rounding moves.
    assert metres[0].numVotes == pytest.approx(sum(pose.numVotes for pose in fine), rel=0.1)
    assert not hasattr(cv2.ppf_match_3d.PPF3DDetector, "setSearchParams")


def test_its_distance_step_is_not_read(cloud: np.ndarray) -> None:
    one, other = matched(cloud, 1000.0), matched(cloud, 1000.0, distance_step=0.5)
    assert [pose.numVotes for pose in one] == [pose.numVotes for pose in other]
    np.testing.assert_array_equal(one[0].pose, other[0].pose)


def test_threads_are_put_back_after_a_failure() -> None:
    module = surface_matching()
    before = module.getNumThreads()

    def fail() -> None:
        with threads(module, before + 1):
            assert module.getNumThreads() == before + 1
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert module.getNumThreads() == before
