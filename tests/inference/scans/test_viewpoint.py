"""Points of a cloud's frame come back to the camera that saw them, in blocks, missing ones staying missing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import apply, quaternion_from_matrix, random_quaternion
from attentionvote.inference.scans.limits import BLOCK_ROWS, Budget
from attentionvote.inference.scans.viewpoint import in_camera_frame, viewpoint_pose


@given(st.integers(0, 2**32 - 1))
def test_what_the_camera_saw_comes_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = [*rng.uniform(-2, 2, 3), *random_quaternion(rng) * rng.uniform(0.995, 1.005)]
    pose = viewpoint_pose([repr(float(number)) for number in numbers])
    assert pose is not None
    np.testing.assert_allclose(pose[:3, 3], numbers[:3])
    np.testing.assert_allclose(abs(quaternion_from_matrix(pose[:3, :3]) @ numbers[3:]), 1, atol=0.006)
    camera = rng.normal(size=(50, 3))
    camera[7] = np.nan
    points = apply(pose, camera).astype(np.float32)
    in_camera_frame(points, pose, Budget())
    np.testing.assert_allclose(points, camera, atol=3e-6)


def test_all_blocks_are_moved_once() -> None:
    pose = viewpoint_pose(["0", "0", "1", "1", "0", "0", "0"])
    points = np.tile(np.float32([[0.5, 0.25, 2]]), (BLOCK_ROWS + 3, 1))
    in_camera_frame(points, pose, Budget(most_seconds=60))
    np.testing.assert_array_equal(points, np.tile(np.float32([[0.5, 0.25, 1]]), (BLOCK_ROWS + 3, 1)))
    with pytest.raises(ValueError, match="processor time"):
        in_camera_frame(points, pose, Budget(most_seconds=0))


def test_what_leaves_float32_is_missing() -> None:
    points = np.float32([[3.4e38, 3.4e38, -3.4e38], [1, 2, 3]])
    in_camera_frame(points, viewpoint_pose(["0", "0", "0", "0.9238795325", "0.3826834324", "0", "0"]), Budget())
    assert np.isnan(points[0]).all()
    assert np.isfinite(points[1]).all()


@pytest.mark.parametrize("words", [[], ["0", "0", "0", "1", "0", "0", "0"], ["-0", "0", "0.0", "-1", "0", "0", "0"]])
def test_the_same_frame_is_no_pose(words: list[str]) -> None:
    assert viewpoint_pose(words) is None
