"""Answers of the network as detections beside the truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from attentionvote.data.samples import Batch
from attentionvote.geometry.pose import matrix_from_quaternion, quaternion_from_matrix
from attentionvote.model.predictions import Predictions
from attentionvote.training.detections import scene_results


@pytest.fixture
def batch(make_scenes: Callable) -> Batch:
    return make_scenes(3, 1, 0)


@pytest.fixture
def predictions(make_rotations: Callable) -> Predictions:
    """Three samples of four proposals: some without heat, some without confidence."""
    rng = np.random.default_rng(0)
    heat = torch.tensor([[2.0, 1.0, 0.4, 0.0], [0.5, 0.39, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    confidence = torch.tensor([[0.9, 0.2, 0.7, 0.8], [0.1, 0.9, 0.9, 0.9], [1.0, 1.0, 1.0, 1.0]])
    center = torch.from_numpy(rng.normal(size=(3, 4, 3))).float()
    quaternion = torch.from_numpy(quaternion_from_matrix(make_rotations(0, 12))).float().view(3, 4, 4)
    return Predictions(torch.zeros(3, 5, 3), center, heat, center, quaternion, torch.zeros(3, 4, 1), confidence)


def test_heat_and_confidence_decide_and_poses_are_complete(predictions: Predictions, batch: Batch) -> None:
    results = scene_results(predictions, batch, 0.4)
    assert [len(r.poses) for r in results] == [3, 1, 0]
    np.testing.assert_allclose(results[0].scores, [0.9, 0.2, 0.7], rtol=1e-6)
    for k in range(3):
        np.testing.assert_allclose(results[0].poses[k, :3, 3], predictions.center[0, k], atol=1e-9)
        expected = matrix_from_quaternion(predictions.quaternion[0, k].double().numpy())
        np.testing.assert_allclose(results[0].poses[k, :3, :3], expected, atol=1e-9)
    sure = scene_results(predictions, batch, 0.4, confidence_threshold=0.5)
    assert [r.scores.round(3).tolist() for r in sure] == [[0.9, 0.7], [], []]


def test_the_truth_has_no_padding_and_occlusion_is_what_is_not_visible(predictions: Predictions, batch: Batch) -> None:
    batch = batch._replace(visible=torch.tensor([[1.0, 0.25, 1.0 + 1e-6], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    results = scene_results(predictions, batch, 0.4)
    assert [len(r.gt_poses) for r in results] == [3, 1, 0]
    np.testing.assert_allclose(results[0].gt_occlusion, [0, 0.75, 0], atol=1e-6)
    # Hidden completely, but there: not padding.
    np.testing.assert_allclose(results[1].gt_occlusion, [1.0])
    np.testing.assert_allclose(results[0].gt_poses[1, :3, 3], batch.center[0, 1], atol=1e-7)
    np.testing.assert_allclose(results[0].gt_poses[1, :3, :3], batch.rotation[0, 1], atol=1e-7)


def test_half_precision_answers_are_accepted(predictions: Predictions, batch: Batch) -> None:
    half = Predictions(*(t.bfloat16() for t in predictions))
    assert [len(r.poses) for r in scene_results(half, batch, 0.3)] == [3, 2, 0]
