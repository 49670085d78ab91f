"""Scenes: what a record promises is checked when it is made."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from attentionvote.scene import BACKGROUND, Scene


def fields(points: int = 5, instances: int = 2) -> dict[str, Any]:
    """Everything a valid scene holds."""
    rng = np.random.default_rng(0)
    ids = rng.integers(BACKGROUND, max(instances, 0), points).astype(np.int32)
    return {
        "points": rng.normal(size=(points, 3)).astype(np.float32),
        "instance_ids": ids,
        "camera_from_part": np.tile(np.eye(4), (instances, 1, 1)),
        "visible_fraction": np.linspace(0, 1, instances),
        "part_ids": np.zeros(instances, dtype=np.int32),
    }


@pytest.mark.parametrize(("points", "instances"), [(5, 2), (0, 2), (5, 0), (0, 0)])
def test_full_and_empty_scenes_are_possible(points: int, instances: int) -> None:
    scene = Scene(**fields(points, instances))
    assert scene.normals is None
    assert len(scene.points) == points
    assert len(scene.camera_from_part) == instances


def test_a_scene_may_carry_normals() -> None:
    normals = np.tile(np.float32([0, 0, -1]), (5, 1))
    np.testing.assert_array_equal(Scene(**fields(), normals=normals).normals, normals)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("points", np.zeros((5, 2), np.float32), r"scene points must have shape \(5, 3\), got \(5, 2\)"),
        ("instance_ids", np.zeros(4, np.int32), r"instance_ids must have shape \(5,\), got \(4,\)"),
        ("camera_from_part", np.zeros((2, 3, 4)), r"camera_from_part must have shape \(2, 4, 4\), got \(2, 3, 4\)"),
        ("visible_fraction", np.zeros(3), r"visible_fraction must have shape \(2,\), got \(3,\)"),
        ("part_ids", np.zeros((2, 1), np.int32), r"part_ids must have shape \(2,\), got \(2, 1\)"),
        ("normals", np.zeros((4, 3), np.float32), r"normals must have shape \(5, 3\), got \(4, 3\)"),
        ("points", np.full((5, 3), np.nan, np.float32), "points must be finite, got 5 points with NaN or inf"),
        ("points", np.full((5, 3), np.inf, np.float32), "points must be finite"),
        ("instance_ids", np.full(5, 2, np.int32), r"instance_ids must lie in -1\.\.1, got 2\.\.2"),
        ("instance_ids", np.full(5, -2, np.int32), r"instance_ids must lie in -1\.\.1, got -2\.\.-2"),
    ],
)
def test_impossible_scenes_are_refused(name: str, value: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Scene(**{**fields(), name: value})


def test_a_scene_without_instances_has_only_background() -> None:
    with pytest.raises(ValueError, match=r"instance_ids must lie in -1\.\.-1"):
        Scene(**{**fields(5, 0), "instance_ids": np.zeros(5, np.int32)})
