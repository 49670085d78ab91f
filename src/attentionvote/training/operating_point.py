"""The confidence that a detection must have: selected on validation scenes, stored with the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from attentionvote.evaluation import PoseMetric, SceneResult, match
from attentionvote.part import Parts

THRESHOLDS = tuple(np.round(np.linspace(0.0, 0.9, 37), 3))


def candidates(scenes: Sequence[SceneResult]) -> tuple[float, ...]:
    """Thresholds worth trying: ``THRESHOLDS``, or as many quantiles where confidences go beyond 1 (Eq. 10)."""
    scores = np.concatenate([np.zeros(1), *(scene.scores for scene in scenes)])
    if scores.max() <= 1:
        return THRESHOLDS
    return (0.0, *np.unique(np.quantile(scores[1:], np.linspace(0, 1, len(THRESHOLDS) - 1))))


def confident(scenes: Sequence[SceneResult], threshold: float) -> list[SceneResult]:
    """The same scenes with only the detections of at least this confidence."""
    return [scene.above(threshold) for scene in scenes]


def best_threshold(scenes: Sequence[SceneResult], part: Parts, fraction: float = 0.1) -> float:
    """The confidence threshold with the best F1 at ``fraction`` x D, the lowest of equals.

    Args:
        scenes: validation scenes with all detections, so that the test scenes stay unseen.
        part: their part, or set of parts; D is then that of each, and the detections of all count together.
        fraction: of D.
    """
    metrics = [PoseMetric.of(member) for member in part.parts]
    best, best_f1 = 0.0, -1.0
    for threshold in candidates(scenes):
        right = wrong = missed = 0
        for scene in confident(scenes, threshold):
            for k, (member, metric) in enumerate(zip(part.parts, metrics, strict=True)):
                part_scene = scene.of_part(k)
                distances = metric.distances(part_scene.poses, part_scene.gt_poses)
                matching = match(distances, part_scene.scores, part_scene.to_find(), fraction * member.diameter)
                right += len(matching.true_positives)
                wrong, missed = wrong + len(matching.false_positives), missed + len(matching.misses)
        f1 = 2 * right / max(1, 2 * right + wrong + missed)
        if f1 > best_f1 + 1e-9:
            best, best_f1 = float(threshold), f1
    return best
