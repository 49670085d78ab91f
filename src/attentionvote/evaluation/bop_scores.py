"""BOP's 6D detection score with MSSD: ``bop25_mAP`` and ``bop25_mAP_mm`` (eval_bop24_pose.py of the BOP toolkit).

Stated here because it is easy to get wrong: every true pose may be matched, also one that hardly shows, but only
poses of at least ``LEAST_VISIBLE`` count. Results for objects that are not in the image take part in the limit of
results an image and are then dropped; they are not false positives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.evaluation.bop_files import BopPoses, Image
from attentionvote.evaluation.coco_precision import ImageErrors, coco_precision
from attentionvote.evaluation.mssd import SurfaceDistance
from attentionvote.evaluation.result_files import unit_problem
from attentionvote.evaluation.scene_result import Array

SHARES = np.arange(0.05, 0.51, 0.05)  # of the diameter; the toolkit's doubles
LENGTHS_MM = np.arange(2.0, 21.0, 2.0)
LEAST_VISIBLE = 0.1
RESULT_LIMIT = 100
RESULT_LIMITS = {"xyzibd": 200}  # data sets with a limit of their own


class ScoredModel(NamedTuple):
    """Facts of a model: ``diameter`` in metres (largest vertex distance), ``symmetries`` ``(S, 4, 4)`` in metres.

    The symmetries are ``mssd.symmetry_transforms`` of the file's own numbers, also where those are nearly but not quite
    a group (LINEMOD's eggbox and glue): the toolkit takes them as they are, and a figure is to be the toolkit's.
    """

    diameter: float
    symmetries: Array


@dataclass(frozen=True)
class ObjectScores:
    """One object: ``map``, ``map_mm`` are the means of ``ap`` ``(10,)`` at ``SHARES`` and ``ap_mm`` ``(10,)`` at
    ``LENGTHS_MM``; ``targets`` poses had to be found, ``estimates`` results were looked at."""

    map: float
    map_mm: float
    ap: list[float] = field(repr=False)
    ap_mm: list[float] = field(repr=False)
    targets: int
    estimates: int


@dataclass(frozen=True)
class BopScores:
    """All objects that had to be found: ``map`` (bop25_mAP) and ``map_mm`` (bop25_mAP_mm) are their means.

    ``beyond_limit``: results dropped by the limit an image; ``elsewhere``: results of objects that are not in the
    image, dropped too.
    """

    map: float
    map_mm: float
    per_object: dict[int, ObjectScores]
    images: int
    beyond_limit: int
    elsewhere: int


def bop_scores(
    estimates: BopPoses,
    truth: BopPoses,
    images: Sequence[Image],
    models: Mapping[int, ScoredModel],
    vertices: Mapping[int, Array],
    result_limit: int = RESULT_LIMIT,
) -> BopScores:
    """Score the results of a split.

    Args:
        estimates, truth: with scores and visible fractions.
        images: those that count, also without a result or a true pose; results elsewhere must have been left out.
        models: facts of every object of the ground truth.
        vertices: ``(V, 3)`` in metres of every object of the ground truth.
        result_limit: the best results of an image that count, over all objects.

    Raises:
        ValueError: with one sentence, when results lie in no image, an object has no model, no pose is visible
            enough to count, or the results are in another unit.
    """
    image_ids = set(images)
    lost = [i for i, image in enumerate(map(tuple, estimates.images.tolist())) if image not in image_ids]
    if lost:
        scene, image = estimates.images[lost[0]]
        raise ValueError(
            f"every image of the results must be in the ground truth, got {len(lost)} results without, "
            f"the first is of scene {scene}, image {image}"
        )
    missing = sorted(set(truth.objects.tolist()) - (set(models) & set(vertices)))
    if missing:
        raise ValueError(f"every object of the ground truth must have a model, got none of object {missing[0]}")
    if not (truth.values >= LEAST_VISIBLE).any():
        raise ValueError(f"at least one true pose must be visible by {LEAST_VISIBLE}, got none of {len(truth.values)}")
    estimated_mm, true_mm = (1000 * p.poses[:, :3, 3] for p in (estimates, truth))
    if problem := unit_problem(estimated_mm, true_mm, "millimetres", "metres"):
        raise ValueError(problem)
    limited = _within_limit(estimates, result_limit)
    errors, elsewhere = _errors(limited, truth, models, vertices)
    per_object = {}
    for number, listed in errors.items():
        targets = sum(int(image.counts.sum()) for image in listed)
        if not targets:
            continue
        diameter = models[number].diameter
        ap = [coco_precision([e._replace(errors=e.errors / diameter) for e in listed], t) or 0.0 for t in SHARES]
        ap_mm = [coco_precision([e._replace(errors=1000 * e.errors) for e in listed], t) or 0.0 for t in LENGTHS_MM]
        result_count = sum(len(image.scores) for image in listed)
        per_object[number] = ObjectScores(float(np.mean(ap)), float(np.mean(ap_mm)), ap, ap_mm, targets, result_count)
    return BopScores(
        float(np.mean([o.map for o in per_object.values()])),
        float(np.mean([o.map_mm for o in per_object.values()])),
        per_object,
        len(image_ids),
        len(estimates.values) - len(limited.values),
        elsewhere,
    )


def selected(poses: BopPoses, rows: NDArray[np.int64] | NDArray[np.bool_]) -> BopPoses:
    """The poses of the given indices ``(M,)``, or of a mask ``(N,)``."""
    return BopPoses(poses.images[rows], poses.objects[rows], poses.poses[rows], poses.values[rows])


def _within_limit(estimates: BopPoses, limit: int) -> BopPoses:
    """The best results of every image, best first; equal scores keep the file's order."""
    order = np.argsort(-estimates.values, kind="stable")
    order = order[np.lexsort((estimates.images[order, 1], estimates.images[order, 0]))]
    image = estimates.images[order]
    starts = np.flatnonzero(np.r_[True, (image[1:] != image[:-1]).any(1)]) if len(order) else np.zeros(0, np.int64)
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    return selected(estimates, order[rank < limit])


def _errors(
    estimates: BopPoses, truth: BopPoses, models: Mapping[int, ScoredModel], vertices: Mapping[int, Array]
) -> tuple[dict[int, list[ImageErrors]], int]:
    """MSSD in metres of every object in every image it occurs in, and the number of results of other objects."""
    by_object: dict[int, list[ImageErrors]] = {}
    used = 0
    keys = np.c_[truth.images, truth.objects]
    ours = np.c_[estimates.images, estimates.objects]
    places = _groups(ours)
    distances = {
        number: SurfaceDistance(vertices[number], models[number].symmetries, reach=models[number].diameter)
        for number in set(truth.objects.tolist())
    }
    for key, there in _groups(keys).items():
        number = key[2]
        rows = places.get(key, np.zeros(0, dtype=np.int64))
        used += len(rows)
        table = distances[number].distances(estimates.poses[rows], truth.poses[there])
        entry = ImageErrors(table, estimates.values[rows], truth.values[there] >= LEAST_VISIBLE)
        by_object.setdefault(number, []).append(entry)
    return dict(sorted(by_object.items())), len(estimates.values) - used


def _groups(keys: NDArray[np.int64]) -> dict[tuple[int, ...], NDArray[np.int64]]:
    """Indices of the rows of every distinct key, keys sorted, rows in their order."""
    rows: dict[tuple[int, ...], list[int]] = {}
    for index, key in enumerate(keys.tolist()):
        rows.setdefault(tuple(key), []).append(index)
    return {key: np.array(rows[key], dtype=np.int64) for key in sorted(rows)}
