"""Point clouds from files, told apart by their first bytes: PLY, PCD, NPY, NPZ, text. No header is believed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans import pcd_file, ply_file
from attentionvote.inference.scans.array_bytes import NPZ_MAGIC, array_from_npy, points_from_npz
from attentionvote.inference.scans.depth_files import PNG_MAGIC
from attentionvote.inference.scans.file_bytes import Content, content_view
from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.missing_points import cloud_of
from attentionvote.inference.scans.npy_header import NPY_MAGIC
from attentionvote.inference.scans.other_kinds import other_kind
from attentionvote.inference.scans.sentences import single_line
from attentionvote.inference.scans.text_cloud import points_from_text, text_rows_start

_COLUMNS = (3, 4, 6)  # x y z; and an intensity; and a normal or a colour


def read_cloud(source: Path | str | Content, name: str = "", *, budget: Budget | None = None) -> NDArray[np.float32]:
    """All points of a file, in its unit: ``(P, 3)``, or ``(H, W, 3)`` where the file keeps an image's order.

    Missing points (a coordinate that is not finite, or all three 0) are NaN in all three coordinates. The frame is the
    file's; a PCD's VIEWPOINT is applied. The array is new and writable, and refers to nothing of the content.

    Args:
        source: path, or the file's content, which is not copied.
        name: for messages when the content is given.
        budget: what reading may cost; None: the usual one.

    Raises:
        InputError: with one sentence, when it is no cloud, damaged, too large or too slow to read.
    """
    content, name = content_view(source, name)
    try:
        cloud = _cloud(content, budget or Budget())
        if cloud is None:
            raise InputError(single_line(_unknown(content, name)))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(single_line(f"{name} must be a point cloud, but {error}")) from error
    return cloud


def _cloud(content: memoryview, budget: Budget) -> NDArray[np.float32] | None:
    """The cloud of a file; None when it is of no known kind."""
    head = bytes(content[:8])
    if head.startswith(NPY_MAGIC):
        return _points(array_from_npy(content), budget)
    if head.startswith(NPZ_MAGIC):  # a golden cloud of a bundle, say
        return _points(points_from_npz(content, budget), budget)
    if head.startswith(ply_file.MAGIC):
        return ply_file.points_from_ply(content, budget)
    if head.startswith(pcd_file.MAGIC):
        return pcd_file.points_from_pcd(content, budget)
    rows = text_rows_start(content)
    return None if rows is None else points_from_text(content, *rows, budget)


def _unknown(content: memoryview, name: str) -> str:
    if bytes(content[:8]) == PNG_MAGIC:
        return f"{name} must be a point cloud, got a PNG: a depth image needs its camera (`--cell`)"
    if (kind := other_kind(content, name)) is not None:
        return (
            f"{name} must be a point cloud as PLY, PCD, NPY, NPZ or XYZ text, got {kind}: "
            "export it so from the sensor's viewer or SDK, or unpack it"
        )
    return f"{name} must be a point cloud as PLY, PCD, NPY, NPZ or XYZ text, got another kind of file"


def _points(array: NDArray[Any], budget: Budget) -> NDArray[np.float32]:
    """Points of an array ``(P, 3)`` or ``(H, W, 3)``, with more columns, or of records ``(P,)`` or ``(H, W)``."""
    if array.dtype.names is not None:
        shape, axes = array.shape, _named_axes(array)
    else:
        shape, axes = array.shape[:-1], [array[..., axis] for axis in range(3)] if _has_columns(array) else []
    if not axes or len(shape) not in (1, 2):
        transposed = ": transpose it" if array.ndim == 2 and array.shape[0] in _COLUMNS else ""
        raise ValueError(
            f"its array must have shape (P, 3) or (H, W, 3), of 4 or 6 columns the first three are read, "
            f"got {array.shape}{transposed}"
        )
    for axis in axes:
        if axis.dtype.kind != "f":
            raise ValueError(f"its values must be floating-point metres, got {axis.dtype}")
    if not array.flags.c_contiguous:
        budget.take(array.nbytes)  # flattening copies each column
    return cloud_of([axis.reshape(-1) for axis in axes], budget).reshape(*shape, 3)


def _has_columns(array: NDArray[Any]) -> bool:
    return array.ndim in (2, 3) and array.shape[-1] in _COLUMNS


def _named_axes(array: NDArray[Any]) -> list[NDArray[Any]]:
    """The fields x, y and z of records, in capitals or not."""
    axes = []
    for axis in "xyz":
        names = [name for name in array.dtype.names or () if name.lower() == axis]
        if len(names) != 1 or array[names[0]].shape != array.shape:
            fields = ", ".join(array.dtype.names or ())[:80]
            raise ValueError(f"its records must have the fields x, y and z once each, got {fields}")
        axes.append(array[names[0]])
    return axes
