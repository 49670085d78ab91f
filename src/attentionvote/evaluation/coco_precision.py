"""Average precision as COCO and BOP's 6D detection task compute it: greedy by score, pooled, 101 points of recall.

Another figure than Bregier's (``average_precision``): there the nearer result wins a pose and scenes are averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.evaluation.scene_result import Array

RECALL_POINTS = np.linspace(0.0, 1.0, 101)  # these very doubles: 7 / 20 is below the thirty-sixth of them


class ImageErrors(NamedTuple):
    """One image's results for one object, against its ground truth.

    ``errors`` ``(R, I)`` any length, ``scores`` ``(R,)``, ``counts`` ``(I,)`` whether a pose is to be found; the
    others (hardly visible) may be matched, and what is matched to them is neither right nor wrong.
    """

    errors: Array
    scores: Array
    counts: NDArray[np.bool_]


def match_greedily(errors: Array, scores: Array, threshold: float) -> NDArray[np.int64]:
    """Ground truth ``(R,)`` of every result, -1 without one.

    By falling score (the earlier first among equals), each result takes, of the poses that are still free, the one
    with the least error if that is *below* the threshold (bop_toolkit_lib/pose_matching.py).
    """
    taken = np.full(len(scores), -1, dtype=np.int64)
    if not errors.size:
        return taken
    free = np.where(errors < threshold, errors, np.inf)
    for result in np.argsort(-scores, kind="stable"):
        truth = int(free[result].argmin())
        if free[result, truth] < np.inf:
            taken[result] = truth
            free[:, truth] = np.inf
    return taken


def interpolated_precision(right: NDArray[np.bool_], required: int) -> float:
    """Mean over ``RECALL_POINTS`` of the best precision at that recall or more (COCO).

    Args:
        right: ``(D,)`` whether each detection is right, by falling score; ignored ones are not in it.
        required: number of poses to be found, at least 1.
    """
    hits = np.cumsum(right)
    precision = hits / np.arange(1, len(right) + 1)
    best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(best[np.searchsorted(hits / required, RECALL_POINTS, side="left")].mean())


def coco_precision(images: Sequence[ImageErrors], threshold: float) -> float | None:
    """Average precision of one object over all images; None when nothing is to be found.

    Args:
        images: those in which the object occurs; equal scores keep their order.
        threshold: in the unit of the errors; errors below it (exclusive) are right.
    """
    required = sum(int(image.counts.sum()) for image in images)
    if not required:
        return None
    scores, right = [], []
    for image in images:
        truth = match_greedily(image.errors, image.scores, threshold)
        matched = truth >= 0
        hit = np.zeros(len(truth), dtype=bool)
        hit[matched] = image.counts[truth[matched]]
        counted = hit | ~matched
        # Within an image too by falling score, so that equal scores of several images keep the toolkit's order.
        order = np.argsort(-image.scores, kind="stable")
        order = order[counted[order]]
        scores.append(image.scores[order])
        right.append(hit[order])
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return interpolated_precision(np.concatenate(right)[order], required)
