"""Uncertainty of a figure: how much it hangs on which piles were drawn (jackknife over drop cycles, Student's t).

A figure is computed again without each drop cycle in turn; from how much these differ follows how much it would differ
on other piles. Drop cycles are the unit, neither poses nor scenes: the parts of one pile are found or missed together,
and the scenes of one cycle are a pile that grows. Cycles are few, so the interval has Student's quantile in place of
the normal one, and a share near 1 varies less than one near a half, so it is made on the scale on which all vary alike
(arcsine of the root). Two models on the same scenes are compared without the same cycles (paired), which removes what
both find hard. What an interval does not say: how much another training, of another seed say, would differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from attentionvote.evaluation.by_part import by_part
from attentionvote.evaluation.matching import score_curve
from attentionvote.evaluation.pose_distance import PoseMetric
from attentionvote.evaluation.scene_result import Array, SceneResult, distance_tables
from attentionvote.evaluation.scores import DETAIL_THRESHOLD, THRESHOLDS
from attentionvote.part import Part, Parts

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A value of these piles, and ``low`` to ``high``: of ``LEVEL`` of all sets of piles, it holds the value of all."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class LeftOut:
    """A figure between 0 and 1 of all drop cycles and without each.

    Attributes:
        value: of all.
        without: ``(C,)`` without cycle 0, without cycle 1, ...; at least two.
    """

    value: float
    without: Array = field(repr=False)

    def interval(self) -> Interval:
        """Of the figure."""
        angle, reach = float(_angle(self.value)), _reach(_angle(self.without))
        low, high = np.sin(np.clip([angle - reach, angle + reach], 0, np.pi / 2)) ** 2
        return Interval(self.value, float(low), float(high))

    def minus(self, other: LeftOut) -> Interval:
        """Of the difference to another figure on the same scenes.

        Raises:
            ValueError: when the other figure is not of as many cycles.
        """
        if len(self.without) != len(other.without):
            raise ValueError(
                f"a difference must be of figures of the same cycles, got {len(self.without)} and {len(other.without)}"
            )
        value, reach = self.value - other.value, _reach(self.without - other.without)
        return Interval(value, value - reach, value + reach)


def _angle(share: Array | float) -> Array:
    return np.arcsin(np.sqrt(np.clip(share, 0, 1)))


def _reach(without: Array) -> float:
    """Half the width of the interval of what has these values ``(C,)`` without each cycle."""
    cycles = len(without)
    return float(stdtrit(cycles - 1, (1 + LEVEL) / 2) * np.sqrt((cycles - 1) * np.var(without)))


def left_out_figures(
    scenes: Sequence[SceneResult], cycles: NDArray[np.integer], part: Parts, working_point: float
) -> dict[str, LeftOut]:
    """``ap_10``, ``ap_5``, ``ap_2``, ``precision_10`` and ``recall_10`` of all cycles and without each.

    The figures are those of ``evaluate`` on the scenes that are left: average precision of all results, precision and
    recall of the results at the working point, counted over all scenes together.

    Args:
        scenes: with all results.
        cycles: ``(S,)`` which drop cycle each scene is of, any numbers; of one cycle nothing can be said: no figures.
        part: gives the pose distance and the diameter; or a set of parts, see ``by_part``.
        working_point: score from which on a result counts as a detection.

    Raises:
        ValueError: when cycles and scenes do not belong together.
    """
    cycles = np.asarray(cycles)
    if cycles.shape != (len(scenes),):
        raise ValueError(f"cycles must be ({len(scenes)},), one number a scene, got {cycles.shape}")
    _, cycle_of = np.unique(cycles, return_inverse=True)
    count = cycle_of.max(initial=-1) + 1
    if count < 2:
        return {}
    weights = np.concatenate([np.ones((1, len(scenes))), np.arange(count)[:, None] != cycle_of])

    def figures_of(part_scenes: Sequence[SceneResult], member: Part) -> dict[str, Array]:
        return _weighted_figures(part_scenes, member, working_point, weights)

    figures = by_part(scenes, part, figures_of) if len(part.parts) > 1 else figures_of(scenes, part.parts[0])
    return {name: LeftOut(float(values[0]), values[1:]) for name, values in figures.items()}


def _weighted_figures(
    scenes: Sequence[SceneResult], part: Part, working_point: float, weights: Array
) -> dict[str, Array]:
    """The figures ``(B,)`` of scenes with weights ``(B, S)``: how often each counts."""
    tables = distance_tables(scenes, PoseMetric.of(part))
    shares = weights / weights.sum(axis=1, keepdims=True)
    curves_at = {
        fraction: [
            score_curve(table, scene.scores, scene.to_find(), fraction * part.diameter)
            for scene, table in zip(scenes, tables, strict=True)
        ]
        for fraction in {*THRESHOLDS, DETAIL_THRESHOLD}
    }
    figures = {}
    for fraction in THRESHOLDS:
        curves = curves_at[fraction]
        levels = np.unique(np.concatenate([curve.scores for curve in curves]))[::-1]
        at = [curve.at(levels) for curve in curves]
        precision = np.array([curve.precision[i] for curve, i in zip(curves, at, strict=True)])
        recall = np.array([curve.recall[i] for curve, i in zip(curves, at, strict=True)])
        area = np.sum((shares @ precision) * np.diff(shares @ recall, axis=1, prepend=0.0), axis=1)
        figures[f"ap_{100 * fraction:g}"] = area
    curves = curves_at[DETAIL_THRESHOLD]
    points = [curve.at(np.array([working_point]))[0] for curve in curves]
    right = weights @ np.array([curve.true_positives[i] for curve, i in zip(curves, points, strict=True)])
    wrong = weights @ np.array([curve.false_positives[i] for curve, i in zip(curves, points, strict=True)])
    required = weights @ np.array([curve.required for curve in curves])
    # As in a score curve: nothing given is no mistake, and of nothing to be found nothing is missed.
    figures["precision_10"] = np.where(right + wrong > 0, right / np.maximum(right + wrong, 1), 1.0)
    figures["recall_10"] = np.where(required > 0, right / np.maximum(required, 1), 1.0)
    return figures
