"""Poses compared with the scan they come from: none leaves the cell that cannot be where something was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.answer import Detection

_FIRST = 1024  # points; a cloud's order is random, so hardly a pose needs the others
_RIGID = 1e-6


def plausible(
    detections: Sequence[Detection], points: NDArray[np.float32], card: ModelCard
) -> tuple[tuple[Detection, ...], int]:
    """The detections that are rigid and lie at the measured points, and how many are not or do not.

    Args:
        detections: of the graph.
        points: ``(N, 3)``, in which they were detected, in random order.
        card: of the model; the middle of a pose's box may be as far from the nearest point as its part is large.
    """
    parts = {part.name: part for part in card.each_part}
    remaining = []
    for detection in detections:
        part = parts.get(detection.part, card.part)
        pose = detection.camera_from_part
        middle = pose[:3, :3] @ np.mean(part.box, axis=0) + pose[:3, 3]
        if _is_rigid(pose) and _is_near(middle, points, part.diameter):
            remaining.append(detection)
    return tuple(remaining), len(detections) - len(remaining)


def _is_rigid(pose: NDArray[np.float64]) -> bool:
    turn = pose[:3, :3]
    if not np.isfinite(pose).all():
        return False
    error = np.abs(turn.T @ turn - np.eye(3)).max()
    return bool(error < _RIGID and np.linalg.det(turn) > 0)


def _is_near(middle: NDArray[np.float64], points: NDArray[np.float32], distance: float) -> bool:
    for some in (points[:_FIRST], points[_FIRST:]):
        if len(some) and np.square(some - middle).sum(axis=1).min() <= distance**2:
            return True
    return False
