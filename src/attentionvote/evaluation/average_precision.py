"""Average precision, F1, MAP, R99 and R50 of a set of scenes, as the benchmark's toolbox computes them.

Macro-averaged: precision and recall of every scene are averaged at each score, then the area under
the mean curve is taken (step function, no interpolation). See shared/reference, section 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from attentionvote.evaluation.matching import ScoreCurve, score_curve
from attentionvote.evaluation.scene_result import Array, Distance, SceneResult, distance_tables


@dataclass(frozen=True)
class DetectionScores:
    """Scores of a detector at one distance threshold.

    Args:
        ap: area under the mean precision-recall curve; the headline figure.
        f1: best ``2 p r / (p + r)`` on the mean curve.
        map: mean of the scenes' own average precision.
        r99, r50: largest recall of the mean curve at a precision of at least 0.99 / 0.5.
        pooled_ap: area under the curve of all detections thrown together; not the benchmark's figure.
        tp, fp, fn: counts with all results given, over all scenes.
        precision, recall: with all results given, ``tp / (tp + fp)`` and ``tp / required`` over all scenes;
            their means over scenes are the last points of the curve.
        curve_scores, curve_precision, curve_recall: the mean curve ``(K + 1,)`` from score +inf down.
        per_scene: the curves it is the mean of.
    """

    ap: float
    f1: float
    map: float
    r99: float
    r50: float
    pooled_ap: float
    tp: int
    fp: int
    fn: int
    precision: float
    recall: float
    curve_scores: Array = field(repr=False)
    curve_precision: Array = field(repr=False)
    curve_recall: Array = field(repr=False)
    per_scene: list[ScoreCurve] = field(repr=False)


def average_precision(
    scenes: Sequence[SceneResult],
    metric: Distance,
    threshold: float,
    occlusion_limit: float = 0.5,
    result_limit: int | None = None,
) -> DetectionScores:
    """Score the results of all scenes.

    Args:
        scenes: every scene that was processed, also those without a result.
        metric: distance between poses.
        threshold: metres; results up to it (inclusive) count.
        occlusion_limit: ground truth up to it (inclusive) must be found.
        result_limit: only this many best results of a scene count; all by default.

    Raises:
        ValueError: when there is no scene, or a limit is impossible.
    """
    return score_tables(scenes, distance_tables(scenes, metric), threshold, occlusion_limit, result_limit)


def score_tables(
    scenes: Sequence[SceneResult],
    tables: Sequence[Array],
    threshold: float,
    occlusion_limit: float = 0.5,
    result_limit: int | None = None,
) -> DetectionScores:
    """``average_precision`` from the scenes' distances ``(R, I)``, so that several thresholds share them."""
    if not len(scenes):
        raise ValueError("at least one scene is needed to compute an average precision, got none")
    if not threshold >= 0:
        raise ValueError(f"threshold must be a distance of at least 0 metres, got {threshold}")
    curves = [
        score_curve(table, scene.scores, scene.to_find(occlusion_limit), threshold, result_limit)
        for scene, table in zip(scenes, tables, strict=True)
    ]
    return summarize(curves)


def summarize(curves: Sequence[ScoreCurve]) -> DetectionScores:
    """Average the curves of the scenes (at least one) and take the figures."""
    levels = np.unique(np.concatenate([curve.scores for curve in curves]))[::-1]
    precision, recall = np.zeros(len(levels)), np.zeros(len(levels))
    right, wrong = np.zeros(len(levels), dtype=np.int64), np.zeros(len(levels), dtype=np.int64)
    for curve in curves:
        at = curve.at(levels)
        precision += curve.precision[at]
        recall += curve.recall[at]
        right += curve.true_positives[at]
        wrong += curve.false_positives[at]
    precision /= len(curves)
    recall /= len(curves)
    required = sum(curve.required for curve in curves)
    pooled = ScoreCurve(levels, right, wrong, required)
    total = precision + recall
    f1 = np.where(total > 0, 2 * precision * recall / np.where(total > 0, total, 1.0), 0.0)
    return DetectionScores(
        # The area is signed: rule 4 can lower the recall, and what is lost is taken off again.
        ap=float(np.sum(precision * np.diff(recall, prepend=0.0))),
        f1=float(f1.max()),
        map=float(np.mean([curve.average_precision for curve in curves])),
        r99=_recall_at_precision(precision, recall, 0.99),
        r50=_recall_at_precision(precision, recall, 0.5),
        pooled_ap=pooled.average_precision,
        tp=int(right[-1]),
        fp=int(wrong[-1]),
        fn=int(required - right[-1]),
        precision=float(pooled.precision[-1]),
        recall=float(pooled.recall[-1]),
        curve_scores=levels,
        curve_precision=precision,
        curve_recall=recall,
        per_scene=list(curves),
    )


def _recall_at_precision(precision: Array, recall: Array, limit: float) -> float:
    """Largest recall of the mean curve whose precision is at least ``limit``.

    Where the precision dips below the limit and recovers, the later part counts (bunny sample, 2 % D).
    """
    return float(recall[precision >= limit].max(initial=0.0))
