"""Uncertainty of a figure: the test set drawn anew from its own scenes, many times (Efron's bootstrap).

Scenes are the unit, not poses: the parts of one pile are found or missed together. Two models measured on the same
scenes are compared draw by draw with the same weights (paired), which removes what both find hard.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from attentionvote.evaluation.average_precision import score_tables
from attentionvote.evaluation.by_part import by_part
from attentionvote.evaluation.pose_distance import PoseMetric
from attentionvote.evaluation.scene_result import Array, SceneResult, distance_tables
from attentionvote.evaluation.scores import DETAIL_THRESHOLD, THRESHOLDS
from attentionvote.part import Parts

LEVEL = 0.95
_CHUNK = 100  # draws at once: some ten thousand scores each


@dataclass(frozen=True)
class Interval:
    """Where ``LEVEL`` of the draws lie: percentiles ``low`` and ``high``."""

    low: float
    high: float


def scene_weights(scenes: int, draws: int, seed: int = 0) -> Array:
    """How often each scene occurs in each draw, ``(draws, scenes)``; every row sums to the number of scenes.

    Raises:
        ValueError: when there is no scene or no draw.
    """
    if scenes < 1 or draws < 1:
        raise ValueError(f"a bootstrap needs at least one scene and one draw, got {scenes} and {draws}")
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=draws).astype(np.float64)


def resampled_figures(
    scenes: Sequence[SceneResult], part: Parts, working_point: float, weights: Array
) -> dict[str, Array]:
    """Every draw's ``ap_10``, ``ap_5``, ``ap_2``, ``precision_10`` and ``recall_10``, ``(draws,)`` each.

    The figures are those of ``evaluate`` on the drawn scenes: average precision of all results, precision and recall
    of the results at the working point, counted over all scenes together.

    Args:
        scenes: in the order of the weights' columns, with all results.
        part: gives the pose distance and the diameter; or a set of parts, see ``by_part``.
        working_point: score from which on a result counts as a detection.
        weights: of ``scene_weights``.

    Raises:
        ValueError: when weights and scenes do not belong together.
    """
    if weights.ndim != 2 or weights.shape[1] != len(scenes):
        raise ValueError(f"weights must be (draws, {len(scenes)}), one column a scene, got {weights.shape}")
    if len(part.parts) > 1:
        return by_part(
            scenes, part, lambda part_scenes, member: resampled_figures(part_scenes, member, working_point, weights)
        )
    (part,) = part.parts
    metric = PoseMetric.of(part)
    tables = distance_tables(scenes, metric)
    figures = {}
    for fraction in THRESHOLDS:
        curves = score_tables(scenes, tables, fraction * part.diameter).per_scene
        levels = np.unique(np.concatenate([curve.scores for curve in curves]))[::-1]
        at = [curve.at(levels) for curve in curves]
        precision = np.array([curve.precision[i] for curve, i in zip(curves, at, strict=True)])
        recall = np.array([curve.recall[i] for curve, i in zip(curves, at, strict=True)])
        figures[f"ap_{100 * fraction:g}"] = np.concatenate([
            _areas(weights[start : start + _CHUNK] / len(scenes), precision, recall)
            for start in range(0, len(weights), _CHUNK)
        ])  # fmt: skip
    confident = [scene.above(working_point) for scene in scenes]
    confident_curves = score_tables(
        confident, distance_tables(confident, metric), DETAIL_THRESHOLD * part.diameter
    ).per_scene
    right = weights @ np.array([curve.true_positives[-1] for curve in confident_curves])
    wrong = weights @ np.array([curve.false_positives[-1] for curve in confident_curves])
    required = weights @ np.array([curve.required for curve in confident_curves])
    # As in a score curve: nothing given is no mistake, and of nothing to be found nothing is missed.
    figures["precision_10"] = np.where(right + wrong > 0, right / np.maximum(right + wrong, 1), 1.0)
    figures["recall_10"] = np.where(required > 0, right / np.maximum(required, 1), 1.0)
    return figures


def interval(draws: Array, level: float = LEVEL) -> Interval:
    """The percentile interval of resampled values, or of differences of two models' values.

    Raises:
        ValueError: when there is no draw or the level is no share between 0 and 1.
    """
    if not len(draws) or not 0 < level < 1:
        raise ValueError(f"an interval needs draws and a level between 0 and 1, got {len(draws)} and {level}")
    low, high = np.percentile(draws, [50 * (1 - level), 50 * (1 + level)])
    return Interval(float(low), float(high))


def _areas(shares: Array, precision: Array, recall: Array) -> Array:
    """Areas ``(B,)`` under the mean curves of draws: shares ``(B, S)``, curves ``(S, L)``."""
    return np.sum((shares @ precision) * np.diff(shares @ recall, axis=1, prepend=0.0), axis=1)
