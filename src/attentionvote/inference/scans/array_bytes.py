"""Arrays from the bytes of .npy and .npz files: no pickles, no header is evaluated as Python, no size is believed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.npy_header import npy_header
from attentionvote.inference.scans.zip_members import ZIP_MAGIC, unpacked, zip_members

NPZ_MAGIC = ZIP_MAGIC
_POINTS = "points"


def array_from_npy(content: bytes | memoryview) -> NDArray[Any]:
    """The array of a .npy file, as a view of ``content``: of numbers, or of records with named fields.

    Raises:
        ValueError: with what is wrong, when it is no .npy file of numbers, or its data do not fill its shape exactly.
    """
    view = memoryview(content).cast("B")
    dtype, shape, order, start = npy_header(view)
    size, there = math.prod(shape) * dtype.itemsize, len(view) - start
    if size != there:
        damage = "it is truncated" if size > there else "something follows them"
        raise ValueError(f"its shape {shape} of {dtype} needs {size} bytes, got {there}: {damage}")
    return np.ndarray(shape, dtype, view, start, order="F" if order == "F" else "C")


def arrays_from_npz(content: bytes | memoryview, budget: Budget) -> dict[str, NDArray[Any]]:
    """All arrays of a .npz file by name.

    Raises:
        ValueError: with what is wrong, when it is no .npz file of numbers, or costs more than the budget.
    """
    view = memoryview(content)
    return {
        name.removesuffix(".npy"): array_from_npy(unpacked(view, member, budget))
        for name, member in zip_members(view).items()
    }


def points_from_npz(content: memoryview, budget: Budget) -> NDArray[Any]:
    """The array ``points`` of a .npz file; what lies beside it is not read.

    Raises:
        ValueError: with what is wrong, when it is no .npz file, has no such array, or costs more than the budget.
    """
    members = {name.removesuffix(".npy"): member for name, member in zip_members(content).items()}
    if _POINTS not in members:
        names = ", ".join(members)[:80] or "none"
        raise ValueError(f"its archive must hold an array '{_POINTS}', got {names}: unpack it when it is a packed file")
    return array_from_npy(unpacked(content, members[_POINTS], budget))
