"""A scene's results refuse arrays that do not belong together."""

from __future__ import annotations

import numpy as np
import pytest

from attentionvote.evaluation import SceneResult

ONE = np.eye(4)[None]


def test_scene_result_accepts_empty_lists():
    scene = SceneResult([], [], [], [])
    assert (scene.poses.shape, scene.gt_poses.shape, scene.to_find().shape) == ((0, 4, 4), (0, 4, 4), (0,))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((ONE, [], ONE, [0.0]), r"poses must have shape \(0, 4, 4\), got \(1, 4, 4\)"),
        ((ONE, [1.0], ONE, [0.0, 0.0]), r"gt_poses must have shape \(2, 4, 4\), got \(1, 4, 4\)"),
        ((ONE[:, :3], [1.0], ONE, [0.0]), r"poses must have shape \(1, 4, 4\), got \(1, 3, 4\)"),
        ((ONE, [np.nan], ONE, [0.0]), "scores must be finite, got 1 NaN or inf"),
        ((np.full((1, 4, 4), np.inf), [1.0], ONE, [0.0]), "poses must be finite, got"),
    ],
)
def test_scene_result_names_what_is_wrong(arguments, text):
    with pytest.raises(ValueError, match=text):
        SceneResult(*arguments)
