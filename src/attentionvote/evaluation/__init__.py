"""Quality of a detector: pose distances, matching, average precision, ADD, recall by visibility.

Numpy and scipy only. Definitions follow the toolbox of Bregier et al. (2017).
"""

from attentionvote.evaluation.average_distance import AverageDistance, NearestPointDistance
from attentionvote.evaluation.average_precision import DetectionScores, average_precision
from attentionvote.evaluation.bootstrap import Interval, interval, resampled_figures, scene_weights
from attentionvote.evaluation.by_part import by_part
from attentionvote.evaluation.matching import Matching, ScoreCurve, match, score_curve
from attentionvote.evaluation.metric_file import read_metric
from attentionvote.evaluation.pose_distance import PoseMetric, rotation_errors
from attentionvote.evaluation.result_files import (
    read_ground_truth,
    read_results,
    read_scene_results,
)
from attentionvote.evaluation.scene_result import Distance, SceneResult
from attentionvote.evaluation.scores import Curves, ap_by_threshold, curves, evaluate, evaluate_at

__all__ = [
    "AverageDistance",
    "Curves",
    "DetectionScores",
    "Distance",
    "Interval",
    "Matching",
    "NearestPointDistance",
    "PoseMetric",
    "SceneResult",
    "ScoreCurve",
    "ap_by_threshold",
    "average_precision",
    "by_part",
    "curves",
    "evaluate",
    "evaluate_at",
    "interval",
    "match",
    "read_ground_truth",
    "read_metric",
    "read_results",
    "read_scene_results",
    "resampled_figures",
    "rotation_errors",
    "scene_weights",
    "score_curve",
]
