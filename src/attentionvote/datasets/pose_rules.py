"""Rules for a pose of any format: finite, a rotation, in the unit that the format states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from attentionvote.geometry.pose import rotation_problem, transform

# No bin-picking sensor looks this far in metres, and no part is this near in millimetres.
FARTHEST = 20.0


def poses_in_metres(where: Path | str, rotations: ArrayLike, translations: ArrayLike) -> NDArray[np.float64]:
    """Poses ``(I, 4, 4)`` of rotations ``(I, 3, 3)`` and translations ``(I, 3)`` that are due in metres.

    Raises:
        ValueError: with one sentence naming ``where``, the entry and the rule.
    """
    r, t = _shaped(where, rotations, translations)
    far = np.flatnonzero(np.abs(t).max(-1, initial=0.0) > FARTHEST)
    if len(far):
        raise ValueError(
            f"{where}: the translation of entry {far[0]} must be in metres, got {t[far[0]].tolist()}: "
            "looks like millimetres"
        )
    return transform(r, t)


def poses_in_millimetres(where: Path | str, rotations: ArrayLike, translations: ArrayLike) -> NDArray[np.float64]:
    """Poses ``(I, 4, 4)`` in metres of translations ``(I, 3)`` that are due in millimetres.

    Raises:
        ValueError: with one sentence naming ``where``, the entry and the rule.
    """
    r, t = _shaped(where, rotations, translations)
    near = np.flatnonzero(np.linalg.norm(t, axis=-1) < FARTHEST)
    if len(near):
        raise ValueError(
            f"{where}: the translation of entry {near[0]} must be in millimetres, got {t[near[0]].tolist()}: "
            "looks like metres"
        )
    return transform(r, t / 1000)


def check_depth_range(where: Path | str, clip_start: float, clip_end: float) -> None:
    """ValueError when a range of depth that is due in metres is none, or looks like millimetres."""
    if not (np.isfinite([clip_start, clip_end]).all() and 0 <= clip_start < clip_end):
        raise ValueError(
            f"{where}: clip_start and clip_end must be metres with 0 <= clip_start < clip_end, "
            f"got {clip_start} and {clip_end}"
        )
    if clip_start > FARTHEST:
        raise ValueError(
            f"{where}: clip_start and clip_end must be in metres, got {clip_start} and {clip_end}: "
            "looks like millimetres"
        )


def _shaped(
    where: Path | str, rotations: ArrayLike, translations: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        r = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
        t = np.asarray(translations, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: a pose must have nine numbers R and three numbers t, got others") from error
    if len(r) != len(t):
        raise ValueError(f"{where}: every pose must have R and t, got {len(r)} rotations and {len(t)} translations")
    if not (np.isfinite(r).all() and np.isfinite(t).all()):
        raise ValueError(f"{where}: poses must be finite, got NaN or inf")
    if problem := rotation_problem(r):
        raise ValueError(f"{where}: R of entry {problem[0]} {problem[1]}")
    return r, t
