"""Matching of a scene's results with its truth: mutual nearest neighbours, at one score or at all of them.

A result is right when its nearest ground-truth pose is within the threshold *and* it is, among the
results that are considered, the nearest to that pose. Not greedy by score: the nearer result wins
(shared/reference, section 2, rules 1-6; Bregier et al. 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attentionvote.evaluation.scene_result import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Matching:
    """All results of one scene against its ground truth.

    ``pairs`` ``(M, 2)``: result and ground-truth index of every mutual match, also of a ground truth that
    is too occluded to be required; ``true_positives`` are those that are required; ``ignored``: results
    on the others; ``duplicates``: results within the threshold of a pose which a nearer result holds;
    ``strays``: results near nothing. False positives are the duplicates and the strays.
    ``misses``: required ground truth without a match.
    """

    pairs: Indices
    true_positives: Indices
    ignored: Indices
    duplicates: Indices
    strays: Indices
    misses: Indices

    @property
    def false_positives(self) -> Indices:
        """Indices of duplicates and strays, sorted."""
        return np.sort(np.concatenate([self.duplicates, self.strays]))


@dataclass(frozen=True)
class ScoreCurve:
    """Counts of one scene over ``{+inf}`` and its distinct scores, descending: ``(K + 1,)`` each.

    ``required`` is the number to be found, the denominator of recall.
    """

    scores: Array
    true_positives: Indices
    false_positives: Indices
    required: int

    @property
    def precision(self) -> Array:
        """TP / (TP + FP), 1 without either."""
        positives = self.true_positives + self.false_positives
        return np.where(positives > 0, self.true_positives / np.maximum(positives, 1), 1.0)

    @property
    def recall(self) -> Array:
        """TP / required, 1 when nothing is to be found."""
        return self.true_positives / self.required if self.required else np.ones(len(self.scores))

    def at(self, levels: Array) -> Indices:
        """Indices ``(L,)`` of the points of this curve that hold at other scores: its lowest score not below each."""
        return np.searchsorted(-self.scores, -levels, side="right") - 1

    @property
    def average_precision(self) -> float:
        """Area under the step curve, from recall 0."""
        return float(np.sum(self.precision * np.diff(self.recall, prepend=0.0)))


def best_results(scores: Array, limit: int | None) -> Indices:
    """Indices of the ``limit`` best results (all without a limit), best first; ties keep their order."""
    if limit is not None and limit < 1:
        raise ValueError(f"result_limit must be at least 1, or absent, got {limit}")
    return np.argsort(-scores, kind="stable")[:limit]


def match(
    distances: Array, scores: Array, to_find: NDArray[np.bool_], threshold: float, result_limit: int | None = None
) -> Matching:
    """Match all results of a scene; arguments as of ``score_curve``, whose last point has the same counts.

    Of two results at exactly the same distance the one with the higher score (then the earlier) is nearer.
    """
    order = best_results(scores, result_limit)
    d = distances[order]
    nearest, near = _nearest(d, threshold)
    mutual = np.zeros(len(order), dtype=bool)
    if d.size:
        mutual[near] = d.argmin(0)[nearest[near]] == np.flatnonzero(near)
    required = np.zeros(len(order), dtype=bool)
    required[mutual] = to_find[nearest[mutual]]
    matched_truth = np.zeros(len(to_find), dtype=bool)
    matched_truth[nearest[mutual]] = True

    def pairs(selection: NDArray[np.bool_]) -> Indices:
        return np.stack([order[selection], nearest[selection]], axis=1)[np.argsort(order[selection])]

    return Matching(
        pairs=pairs(mutual),
        true_positives=pairs(mutual & required),
        ignored=np.sort(order[mutual & ~required]),
        duplicates=np.sort(order[near & ~mutual]),
        strays=np.sort(order[~near]),
        misses=np.flatnonzero(to_find & ~matched_truth),
    )


def score_curve(
    distances: Array, scores: Array, to_find: NDArray[np.bool_], threshold: float, result_limit: int | None = None
) -> ScoreCurve:
    """Counts at every distinct score, results of equal score entering together.

    One pass: who is nearest to a ground truth among the first k results is a running minimum, so the
    whole curve costs as much as a few matchings.

    Args:
        distances: ``(R, I)`` metres.
        scores: ``(R,)``, higher is better.
        to_find: ``(I,)`` which ground truth is required.
        threshold: metres, inclusive.
        result_limit: keep this many best results; recall is then out of ``min(limit, required)``.
    """
    order = best_results(scores, result_limit)
    d, s = distances[order], scores[order]
    count, truths = d.shape
    required = int(to_find.sum())
    if result_limit is not None:
        required = min(required, result_limit)
    last = np.flatnonzero(np.diff(s, append=-np.inf))  # last result of every group of equal scores
    levels = np.concatenate([[np.inf], s[last]])
    if count == 0 or truths == 0:
        none = np.zeros(len(levels), dtype=np.int64)
        return ScoreCurve(levels, none, np.concatenate([[0], last + 1]), required)
    nearest, near = _nearest(d, threshold)
    # Result k takes a ground truth over when it is strictly nearer than all before it.
    before = np.concatenate([np.full((1, truths), np.inf), np.minimum.accumulate(d, axis=0)[:-1]])
    holder = np.maximum.accumulate(np.where(d < before, np.arange(count)[:, None], 0), axis=0)[last]
    mutual = near[holder] & (nearest[holder] == np.arange(truths))
    right = (mutual & to_find).sum(1)
    wrong = last + 1 - mutual.sum(1)
    return ScoreCurve(levels, np.concatenate([[0], right]), np.concatenate([[0], wrong]), required)


def _nearest(distances: Array, threshold: float) -> tuple[Indices, NDArray[np.bool_]]:
    """Nearest ground truth ``(R,)`` of every result, and whether it is within the threshold."""
    count, truths = distances.shape
    if truths == 0:
        return np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
    nearest = distances.argmin(1)
    return nearest, distances[np.arange(count), nearest] <= threshold
