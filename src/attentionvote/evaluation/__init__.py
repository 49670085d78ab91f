"""Quality of a detector: pose distances, matching, average precision, ADD, recall by visibility.

Numpy and scipy only. Definitions follow the toolbox of Bregier et al. (2017).
"""

from attentionvote.evaluation.average_precision import DetectionScores, average_precision
from attentionvote.evaluation.intervals import Interval, LeftOut, left_out_figures
from attentionvote.evaluation.matching import match
from attentionvote.evaluation.metric_file import read_metric
from attentionvote.evaluation.pose_distance import PoseMetric, rotation_errors
from attentionvote.evaluation.result_files import read_scene_results
from attentionvote.evaluation.scene_result import SceneResult
from attentionvote.evaluation.scores import ap_by_threshold, curves, evaluate, evaluate_at

__all__ = [
    "DetectionScores",
    "Interval",
    "LeftOut",
    "PoseMetric",
    "SceneResult",
    "ap_by_threshold",
    "average_precision",
    "curves",
    "evaluate",
    "evaluate_at",
    "left_out_figures",
    "match",
    "read_metric",
    "read_scene_results",
    "rotation_errors",
]
