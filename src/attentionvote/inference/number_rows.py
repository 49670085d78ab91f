"""Rows of numbers in a text, read by numpy in C: the ascii forms of the point cloud formats."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_BLOCK = 65536  # rows read at once: only the columns wanted are kept of the whole


def number_rows(text: bytes, skip: int, count: int, width: int, places: Sequence[int]) -> NDArray[np.float64]:
    """Some columns ``(count, len(places))`` of the rows of a text; empty lines are no rows.

    Args:
        text: lines of numbers between blanks.
        skip: rows before the first one wanted.
        count: rows wanted.
        width: numbers in a row.
        places: indices of the columns wanted.

    Raises:
        ValueError: when there are fewer rows, or one has other numbers than that.
    """
    # A number and its separator have two bytes: a count that cannot be is refused before anything is reserved for it.
    if 2 * (skip + count * width) > len(text) + 2:
        raise ValueError(f"its header promises {count} points, but only {len(text)} bytes follow: it is truncated")
    if not count:
        return np.zeros((0, len(places)))
    lines = io.BytesIO(text)
    for _ in range(skip):
        _next_row(lines)
        lines.readline()
    blocks, left = [], count
    while left:
        if not _next_row(lines):
            raise ValueError(f"its header promises {count} points, but only {count - left} follow: it is truncated")
        try:
            rows = np.loadtxt(lines, np.float64, comments=None, max_rows=min(left, _BLOCK), ndmin=2, encoding="latin-1")
        except ValueError as error:
            raise ValueError(f"its points must be rows of {width} numbers, got something else") from error
        if rows.shape[1] != width:
            raise ValueError(f"its points must be rows of {width} numbers, got rows of {rows.shape[1]}")
        blocks.append(rows[:, places])
        left -= len(rows)
    return np.concatenate(blocks)


def _next_row(lines: io.BytesIO) -> bool:
    """Go to the beginning of the next line that is not empty; False when there is none."""
    start = lines.tell()
    while (line := lines.readline()).decode("latin-1").isspace():
        start = lines.tell()
    lines.seek(start)
    return bool(line)
