"""The figures of Sileane's result files, for the verb score."""

from __future__ import annotations

from typing import Any

import numpy as np

from attentionvote.evaluation import DetectionScores, read_metric, read_scene_results
from attentionvote.evaluation.average_precision import score_tables, summarize
from attentionvote.evaluation.scene_result import distance_tables
from attentionvote.workflows.settings import ScoreSettings

CURVE_STEPS = 20


def scored(cfg: ScoreSettings) -> dict[str, Any]:
    """Figures over all scenes, and of every scene alone (docs/scoring.md says what each means).

    Raises:
        ValueError: with one sentence, when a file is missing or wrong.
    """
    assert cfg.poseutils is not None
    metric, full = read_metric(cfg.poseutils, cfg.frame)
    threshold = cfg.threshold_scale * full
    named = read_scene_results(cfg.gt, cfg.results)
    scenes = list(named.values())
    tables = distance_tables(scenes, metric)
    scores = score_tables(scenes, tables, threshold, cfg.occlusion, cfg.result_limit)
    result: dict[str, Any] = {
        "format": "sileane",
        "frame": cfg.frame,
        "occlusion": cfg.occlusion,
        "threshold_m": threshold,
        "scenes": len(scenes),
        **figures(scores),
        "pooled_ap": scores.pooled_ap,
        "per_scene": {name: figures(summarize([curve])) for name, curve in zip(named, scores.per_scene, strict=True)},
    }
    if cfg.curve:
        steps = [float(t) for t in np.arange(CURVE_STEPS + 1) / CURVE_STEPS * threshold]
        ap = [score_tables(scenes, tables, t, cfg.occlusion, cfg.result_limit).ap for t in steps]
        result["curve"] = {"threshold_m": steps, "ap": ap}
    return result


def figures(scores: DetectionScores) -> dict[str, float]:
    """The figures of one set of scenes, or of one scene."""
    names = ("ap", "f1", "map", "r99", "r50", "tp", "fp", "fn", "precision", "recall")
    return {name: getattr(scores, name) for name in names}
