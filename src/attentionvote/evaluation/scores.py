"""Everything that is reported of a detector on a set of scenes: flat metrics, and curves for figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from attentionvote.evaluation.average_distance import AverageDistance, NearestPointDistance
from attentionvote.evaluation.average_precision import score_tables
from attentionvote.evaluation.by_part import by_part
from attentionvote.evaluation.matching import Matching, match
from attentionvote.evaluation.pose_distance import PoseMetric, rotation_errors
from attentionvote.evaluation.scene_result import Array, SceneResult, distance_tables
from attentionvote.part import Part, Parts

THRESHOLDS = (0.10, 0.05, 0.02)  # of the diameter
# The figures by which models are compared at a glance, where a model has them.
HEADLINES = (
    "ap_10", "ap_5", "ap_2", "precision_10", "recall_10", "proposal_recall", "center_error_mm", "rotation_error_deg",
    "latency_p50_ms", "latency_p95_ms",
)  # fmt: skip
DETAIL_THRESHOLD = 0.10  # at which recall by visibility and pose errors are reported
VISIBILITY_EDGES = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def evaluate(
    scenes: Sequence[SceneResult],
    part: Parts,
    thresholds: Sequence[float] = THRESHOLDS,
    add: bool = True,
    metric: PoseMetric | None = None,
    occlusion_limit: float = 0.5,
    result_limit: int | None = None,
) -> dict[str, float]:
    """Flat metrics; ``N`` stands for a threshold in per cent of the diameter (``10``, ``5``, ``2``).

    * ``ap_N``, ``map_N``, ``f1_N``: the benchmark's macro-averaged figures;
    * ``precision_N``, ``recall_N``: all results given, counted over all scenes together;
    * ``duplicates_N``: results on a pose that a nearer result holds; ``strays_N``: results near nothing
      (both are false positives); ``misses_N``: required poses that were not found;
    * ``add_precision_N``, ``add_recall_N``: the same with ADD (Eq. 13) in place of the pose distance;
    * ``add_s_precision_N``, ``add_s_recall_N``: with ADD-S, the mean distance to the *nearest* model point;
    * ``recall_visible_50_60`` ... ``recall_visible_90_100``: recall at 10 % D by visible per cent, lower
      edge included (the last bin also holds 100);
    * ``center_error_mm``, ``rotation_error_deg``: medians over the true positives at 10 % D.

    What nothing can be measured on (an empty visibility bin, no true positive) is absent. Of a set of parts the figures
    are those of ``by_part``: means over the parts, and each part's own as ``NAME/figure``.

    Args:
        scenes: every scene that was processed, also those without results.
        part: gives diameter, symmetry and model points; or a set of parts.
        thresholds: fractions of the diameter; fewer are cheaper.
        add: whether to compute the ADD and ADD-S figures, most of the time spent here.
        metric: pose distance; of the part by default. Only for one part.
        occlusion_limit: ground truth occluded up to it (inclusive) must be found.
        result_limit: only this many best results of a scene count; all by default.

    Raises:
        ValueError: when there is no scene or no threshold, or a limit is impossible.
    """
    if len(part.parts) > 1:
        if metric is not None:
            raise ValueError(f"a metric belongs to one part, got one with the {len(part.parts)} parts of {part.name}")
        return by_part(
            scenes,
            part,
            lambda part_scenes, member: evaluate(
                part_scenes, member, thresholds, add, None, occlusion_limit, result_limit
            ),
        )
    (part,) = part.parts
    if not len(thresholds) or not all(t > 0 for t in thresholds):
        raise ValueError(f"thresholds must be at least one positive fraction of the diameter, got {tuple(thresholds)}")
    tables = distance_tables(scenes, metric or PoseMetric.of(part))
    metrics: dict[str, float] = {}
    for fraction in thresholds:
        threshold, name = fraction * part.diameter, f"{100 * fraction:g}"
        scores = score_tables(scenes, tables, threshold, occlusion_limit, result_limit)
        matchings = _match_all(scenes, tables, threshold, occlusion_limit, result_limit)
        metrics |= {f"ap_{name}": scores.ap, f"map_{name}": scores.map, f"f1_{name}": scores.f1}
        metrics |= {f"precision_{name}": scores.precision, f"recall_{name}": scores.recall}
        for kind in ("duplicates", "strays", "misses"):
            metrics[f"{kind}_{name}"] = float(sum(len(getattr(matching, kind)) for matching in matchings))
    if add:
        reach = max(thresholds) * part.diameter
        for kind, distance in (
            ("add", AverageDistance.of(part, reach)),
            ("add_s", NearestPointDistance.of(part, reach)),
        ):
            add_tables = distance_tables(scenes, distance)
            for fraction in thresholds:
                scores = score_tables(scenes, add_tables, fraction * part.diameter, occlusion_limit, result_limit)
                name = f"{100 * fraction:g}"
                metrics |= {f"{kind}_precision_{name}": scores.precision, f"{kind}_recall_{name}": scores.recall}
    matchings = _match_all(scenes, tables, DETAIL_THRESHOLD * part.diameter, occlusion_limit, result_limit)
    return metrics | recall_by_visibility(scenes, matchings) | pose_errors(scenes, matchings, part)


def evaluate_at(scenes: Sequence[SceneResult], part: Parts, working_point: float, add: bool = True) -> dict[str, float]:
    """``evaluate`` of a detector with a working point, the score from which on a result counts as a detection.

    Average precision is an area over all scores (``ap_N``, ``map_N``, ``f1_N``); everything else, precision and recall
    first, is of the detections.

    Args:
        scenes: with all results.
        part, add: as in ``evaluate``.
        working_point: the score.
    """
    everything = evaluate(scenes, part, add=False)
    at_working_point = evaluate([scene.above(working_point) for scene in scenes], part, add=add)
    areas = ("ap_", "map_", "f1_")
    return everything | {k: v for k, v in at_working_point.items() if not k.rpartition("/")[2].startswith(areas)}


def recall_by_visibility(scenes: Sequence[SceneResult], matchings: Sequence[Matching]) -> dict[str, float]:
    """Share of the ground truth that was found, in bins of its visible fraction; empty bins are absent."""
    visible, hit_masks = [], []
    for scene, matching in zip(scenes, matchings, strict=True):
        # Rounded: 1 - 0.4 and the like must land on the edge they mean.
        visible.append(np.round(1 - scene.gt_occlusion, 9))
        hit = np.zeros(len(scene.gt_poses), dtype=bool)
        hit[matching.pairs[:, 1]] = True
        hit_masks.append(hit)
    fraction, hits = np.concatenate(visible), np.concatenate(hit_masks)
    metrics = {}
    for low, high in pairwise(VISIBILITY_EDGES):
        inside = (fraction >= low) & ((fraction < high) | (high == VISIBILITY_EDGES[-1]))
        if inside.any():
            metrics[f"recall_visible_{100 * low:.0f}_{100 * high:.0f}"] = float(hits[inside].mean())
    return metrics


def pose_errors(scenes: Sequence[SceneResult], matchings: Sequence[Matching], part: Part) -> dict[str, float]:
    """Median distance of the origins (mm) and median rotation (degrees, least over the symmetries) of the
    true positives; absent without one."""
    pairs = [matching.true_positives for matching in matchings]
    estimated = np.concatenate([scene.poses[pair[:, 0]] for scene, pair in zip(scenes, pairs, strict=True)])
    true = np.concatenate([scene.gt_poses[pair[:, 1]] for scene, pair in zip(scenes, pairs, strict=True)])
    if not len(estimated):
        return {}
    center_mm = 1000 * np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=-1)
    rotation = np.degrees(rotation_errors(estimated, true, part.symmetry))
    return {"center_error_mm": float(np.median(center_mm)), "rotation_error_deg": float(np.median(rotation))}


class Curves(NamedTuple):
    """``thresholds`` ``(T,)`` fractions of D with ``ap`` ``(T,)`` (Fig. 8 of the paper)."""

    thresholds: Array
    ap: Array


def curves(scenes: Sequence[SceneResult], part: Part) -> Curves:
    """AP against the threshold (0 to 10 % D in steps of half a per cent).

    Raises:
        ValueError: when there is no scene.
    """
    tables = distance_tables(scenes, PoseMetric.of(part))
    fractions = np.array([k / 200 for k in range(21)])
    return Curves(fractions, np.array([score_tables(scenes, tables, t * part.diameter).ap for t in fractions]))


def ap_by_threshold(scenes: Sequence[SceneResult], part: Parts) -> tuple[Array, Array]:
    """Shares of D from 0 to 10 % in steps of half a per cent, and average precision there; of a set the mean."""
    part_scenes = (
        [[scene.of_part(k) for scene in scenes] for k in range(len(part.parts))] if len(part.parts) > 1 else [scenes]
    )
    each = [curves(results, member) for results, member in zip(part_scenes, part.parts, strict=True)]
    return each[0].thresholds, np.mean([curve.ap for curve in each], axis=0)


def _match_all(
    scenes: Sequence[SceneResult],
    tables: Sequence[Array],
    threshold: float,
    occlusion_limit: float,
    result_limit: int | None,
) -> list[Matching]:
    return [
        match(table, scene.scores, scene.to_find(occlusion_limit), threshold, result_limit)
        for scene, table in zip(scenes, tables, strict=True)
    ]
