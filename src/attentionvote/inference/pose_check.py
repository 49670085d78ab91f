"""Poses compared with the scan they come from: none leaves the cell that cannot be where something was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.answer import Detection

_FIRST = 256  # points; a cloud's order is random, so hardly a pose needs the others
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
    if not detections:
        return (), 0
    parts = {part.name: part for part in card.each_part}
    part_of_each = [parts.get(detection.part, card.part) for detection in detections]
    poses = np.stack([detection.camera_from_part for detection in detections])
    boxes = np.array([part.box for part in part_of_each])
    reach = np.array([part.diameter for part in part_of_each])
    right = _are_rigid(poses)
    with np.errstate(invalid="ignore", over="ignore"):
        middles = np.einsum("nij,nj->ni", poses[:, :3, :3], boxes.mean(axis=1)) + poses[:, :3, 3]
        near = _distances(middles, points[:_FIRST]) <= reach
        for i in np.flatnonzero(right & ~near):
            near[i] = _distances(middles[i : i + 1], points[_FIRST:])[0] <= reach[i]
    right &= near
    return tuple(detections[int(i)] for i in np.flatnonzero(right)), int(np.count_nonzero(~right))


def _are_rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the poses ``(n, 4, 4)`` are finite and have a rotation."""
    turns = poses[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(np.einsum("nji,njk->nik", turns, turns) - np.eye(3)).max(axis=(1, 2))
        # The third axis is the product of the others, and not its opposite.
        handed = np.einsum("ni,ni->n", np.cross(turns[:, :, 0], turns[:, :, 1]), turns[:, :, 2]) > 0
    return np.isfinite(poses).all(axis=(1, 2)) & (error < _RIGID) & handed


def _distances(middles: NDArray[np.float64], points: NDArray[np.float32]) -> NDArray[np.float64]:
    """From each of ``(n, 3)`` to the nearest of ``(P, 3)``; infinite where there are none."""
    if not len(points):
        return np.full(len(middles), np.inf)
    return np.sqrt(np.square(middles[:, None] - points[None]).sum(axis=-1).min(axis=1))
