"""Point clouds from files: PLY, PCD, NPY and NPZ, told apart by their first bytes. No size in a header is believed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.measured_points import MOST_POINTS
from attentionvote.inference.scans import pcd_file, ply_file
from attentionvote.inference.scans.array_bytes import NPY_MAGIC, NPZ_MAGIC, array_from_npy, arrays_from_npz
from attentionvote.inference.scans.depth_files import PNG_MAGIC
from attentionvote.inference.scans.file_bytes import file_bytes


def read_cloud(source: Path | str | bytes, name: str = "") -> NDArray[np.float32]:
    """The points ``(P, 3)`` of a file, in the file's unit and frame; missing ones of organised clouds are left out.

    Args:
        source: path, or the file's content.
        name: for messages when the content is given.

    Raises:
        InputError: with one sentence, when it is no cloud, damaged or too large.
    """
    content, name = file_bytes(source, name)
    try:
        if content.startswith(NPY_MAGIC):
            return _points(array_from_npy(content, MOST_POINTS * 24))
        if content.startswith(NPZ_MAGIC):  # a golden cloud of a bundle, say
            return _points(_array_points(arrays_from_npz(content, MOST_POINTS * 24)))
        if content.startswith(ply_file.MAGIC):
            return ply_file.points_from_ply(content, MOST_POINTS)
        if content.startswith(pcd_file.MAGIC):
            return pcd_file.points_from_pcd(content, MOST_POINTS)
    except ValueError as error:
        raise InputError(f"{name} must be a point cloud, but {error}") from error
    if content.startswith(PNG_MAGIC):
        raise InputError(f"{name} must be a point cloud, got a PNG: a depth image needs its camera (`--cell`)")
    raise InputError(f"{name} must be a point cloud as PLY, PCD, NPY or NPZ, got another kind of file")


def _array_points(arrays: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """The array ``points`` of an archive."""
    if "points" not in arrays:
        raise ValueError(f"its archive must hold an array 'points', got {', '.join(arrays)[:80] or 'none'}")
    return arrays["points"]


def _points(array: NDArray[Any]) -> NDArray[np.float32]:
    """Points of an array ``(P, 3)`` or ``(H, W, 3)``."""
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise ValueError(f"its array must have shape (P, 3) or (H, W, 3), got {array.shape}")
    if array.dtype.kind != "f":
        raise ValueError(f"its values must be floating-point metres, got {array.dtype}")
    if array.size > 3 * MOST_POINTS:
        raise ValueError(f"it must have at most {MOST_POINTS} points, got {array.size // 3}")
    with np.errstate(over="ignore", invalid="ignore"):
        points = array.reshape(-1, 3).astype(np.float32)
    return points[~np.isnan(points).any(axis=1)] if array.ndim == 3 else points
