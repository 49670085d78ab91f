"""Numbers for the pictures of fixed validation scenes: votes, heat, poses. Drawing is the tracking's business."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from attentionvote.data.samples import Batch
from attentionvote.evaluation import PoseMetric
from attentionvote.training.module import PoseTraining


@torch.no_grad()
def picture_inputs(module: PoseTraining, batch: Batch, confidence_threshold: float) -> Iterator[dict[str, Any]]:
    """For every sample of a batch the arguments of ``tracking.scene_pictures.scene_picture``.

    Args:
        module: the trained module.
        batch: fixed scenes.
        confidence_threshold: detections below it are not drawn.
    """
    model = module.model
    votes = model.cast_votes(batch.points, batch.normals, batch.found)
    peaks = model.find_peaks(votes)
    metric = PoseMetric.of(module.part)
    for i, result in enumerate(module.detect(batch)):
        shown = result.scores >= confidence_threshold
        poses = result.poses[shown]
        distances = metric.distances(poses, result.gt_poses)
        correct = distances.min(axis=1, initial=np.inf) <= 0.1 * module.part.diameter
        visible = result.gt_occlusion <= 0.5
        yield {
            "points": batch.points[i].numpy(),
            "votes": votes.xyz[i].numpy(),
            "heat": peaks.vote_heat[i].numpy(),
            "peaks": peaks.center_seed[i][peaks.heat[i] >= module.peak_threshold].numpy(),
            "gt_centers": result.gt_poses[visible, :3, 3],
            "predicted_poses": poses,
            "correct": correct,
            "gt_poses": result.gt_poses[visible],
            "vertices": module.part.vertices,
            "faces": module.part.faces,
        }
