"""The figures of a BOP results CSV, for the verb score."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from attentionvote.datasets.bop_models import MODELS_INFO, box_agrees, read_models_info
from attentionvote.evaluation.bop_files import BopPoses, Image, parse_name, read_estimates, read_targets, read_truth
from attentionvote.evaluation.bop_scores import (
    LENGTHS_MM,
    RESULT_LIMIT,
    RESULT_LIMITS,
    SHARES,
    ScoredModel,
    bop_scores,
    selected,
)
from attentionvote.evaluation.mssd import symmetry_transforms
from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.ply_file import points_from_ply
from attentionvote.workflows.settings import ScoreSettings

log = logging.getLogger("attentionvote.score")
MOST_VERTEX_BYTES = 1024 * 1024 * 1024


def scored(cfg: ScoreSettings) -> dict[str, Any]:
    """Figures over all objects, and of every object alone (docs/scoring.md says what each means).

    Raises:
        ValueError: with one sentence, when a file is missing or wrong.
    """
    assert cfg.models is not None
    name = parse_name(cfg.results)
    models = scored_models(Path(cfg.models) / MODELS_INFO)
    truth, images = read_truth(cfg.gt, cfg.suffix)
    estimates, seconds = read_estimates(cfg.results)
    outside = 0
    if cfg.targets is not None:
        targets = read_targets(cfg.targets)
        lost = sorted(targets - set(images))
        if lost:
            raise ValueError(
                f"{cfg.targets}: every target must be in {cfg.gt}, got scene {lost[0][0]}, im {lost[0][1]}"
            )
        images = sorted(targets)
        before = len(estimates.values)
        truth, estimates = _inside(truth, targets), _inside(estimates, targets)
        outside = before - len(estimates.values)
    vertices = {number: _vertices(Path(cfg.models), number, models) for number in sorted(set(truth.objects.tolist()))}
    limit = cfg.result_limit or RESULT_LIMITS.get(name.dataset, RESULT_LIMIT)
    scores = bop_scores(estimates, truth, images, models, vertices, limit)
    if scores.beyond_limit or scores.elsewhere or outside:
        log.info(
            "not looked at: %d results beyond %d an image, %d of objects not in the image, %d outside the targets",
            scores.beyond_limit, limit, scores.elsewhere, outside,
        )  # fmt: skip
    per_object = {str(number): asdict(object_scores) for number, object_scores in scores.per_object.items()}
    return {
        "format": "bop",
        "method": name.method,
        "dataset": f"{name.dataset}-{name.split}",
        "bop25_mAP": scores.map,
        "bop25_mAP_mm": scores.map_mm,
        "seconds_per_image": seconds,
        "images": scores.images,
        "targets": sum(object_scores.targets for object_scores in scores.per_object.values()),
        "estimates": sum(object_scores.estimates for object_scores in scores.per_object.values()),
        "beyond_limit": scores.beyond_limit,
        "elsewhere": scores.elsewhere,
        "outside_targets": outside,
        "result_limit": limit,
        "thresholds": SHARES.round(2),
        "thresholds_mm": LENGTHS_MM,
        "per_object": per_object,
    }


def scored_models(path: Path) -> dict[int, ScoredModel]:
    """Diameter and all symmetries of every model of a ``models_info.json``, as the toolkit takes them.

    Raises:
        ValueError: with one sentence, as ``read_models_info``.
    """
    return {
        number: ScoredModel(model.diameter, symmetry_transforms(model.discrete, model.continuous))
        for number, model in read_models_info(path).items()
    }


def _inside(poses: BopPoses, images: set[Image]) -> BopPoses:
    return selected(poses, np.array([image in images for image in map(tuple, poses.images.tolist())], dtype=bool))


def _vertices(folder: Path, number: int, models: Mapping[int, ScoredModel]) -> np.ndarray:
    """Vertices ``(V, 3)`` in metres of a model; BOP's files are in millimetres."""
    path = folder / f"obj_{number:06d}.ply"
    try:
        points = points_from_ply(memoryview(path.read_bytes()), Budget(MOST_VERTEX_BYTES, math.inf))
    except OSError as error:
        raise ValueError(f"{path}: the model cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ValueError(f"{path}: the model cannot be read, {error}") from error
    # For a scan a point at the origin is a missing one; a model may have a vertex there.
    vertices = np.nan_to_num(points.astype(np.float64), nan=0.0) / 1000
    diameter = 1000 * models[number].diameter if number in models else None
    if diameter and len(vertices) and not box_agrees(diameter, sizes := (1000 * np.ptp(vertices, axis=0)).tolist()):
        raise ValueError(
            f"{path}: the model must be as large as its diameter in {MODELS_INFO}, {diameter:g} mm, got a box of "
            f"{' x '.join(f'{size:.4g}' for size in sizes)}: are both in millimetres?"
        )
    return np.asarray(vertices)
