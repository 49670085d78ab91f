"""Detections of the network's answers, beside the truth, as the evaluation compares them."""

from __future__ import annotations

import numpy as np

from attentionvote.contract import is_detection
from attentionvote.data.samples import Batch
from attentionvote.evaluation import SceneResult
from attentionvote.geometry.pose import matrix_from_quaternion, transform
from attentionvote.model.predictions import Predictions


def scene_results(
    predictions: Predictions, batch: Batch, peak_threshold: float, confidence_threshold: float = 0.0
) -> list[SceneResult]:
    """Detections and truth of every sample of a batch; a detection is of the part with the largest logit.

    Args:
        predictions: of the batch.
        batch: with the truth; padded instances (visibility 0 at an identity pose at the origin) are left out.
        peak_threshold: proposals with less heat are dropped (the paper's 0.4), and places without a peak (heat 0).
        confidence_threshold: proposals with less confidence are dropped.
    """
    results = []
    # Half precision (bf16-mixed) has no counterpart in numpy.
    heat, confidence = predictions.peak_heat.float().cpu().numpy(), predictions.confidence.float().cpu().numpy()
    rotation = matrix_from_quaternion(predictions.quaternion.double().cpu().numpy())
    poses = transform(rotation, predictions.center.double().cpu().numpy())
    detected = is_detection(heat, confidence, peak_threshold, confidence_threshold)
    truth = transform(batch.rotation.double().cpu().numpy(), batch.center.double().cpu().numpy())
    real = (batch.center.abs().sum(-1) > 0).cpu().numpy()
    visible = batch.visible.double().cpu().numpy()
    named, part = predictions.class_logits.float().cpu().numpy().argmax(-1), batch.part.cpu().numpy()
    for i in range(len(poses)):
        occlusion = 1.0 - np.minimum(visible[i, real[i]], 1.0)
        prediction = poses[i, detected[i]], confidence[i, detected[i]]
        results.append(SceneResult(*prediction, truth[i, real[i]], occlusion, named[i, detected[i]], part[i, real[i]]))
    return results
