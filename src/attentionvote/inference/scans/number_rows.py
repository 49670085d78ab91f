"""Rows of numbers in a text, read by numpy in C: the ascii forms of the point cloud formats."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import islice

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
        ValueError: with what is wrong, when there are fewer rows, or one has other numbers than that.
    """
    # A number and its separator have two bytes: a count that cannot be is refused before anything is reserved for it.
    if 2 * (skip + count * width) > len(text) + 2:
        raise ValueError(f"its header promises {count} points, but only {len(text)} bytes follow: it is truncated")
    lines = (line.decode("latin-1") for line in io.BytesIO(text))
    rows = islice((line for line in lines if not line.isspace()), skip, None)
    blocks = [np.zeros((0, len(places)))]
    left = count
    while left:
        some = list(islice(rows, min(left, _BLOCK)))
        if not some:
            raise ValueError(f"its header promises {count} points, but only {count - left} follow: it is truncated")
        try:
            numbers = np.loadtxt(some, np.float64, comments=None, ndmin=2)
        except ValueError as error:
            raise ValueError(f"its points must be rows of {width} numbers, got something else") from error
        if numbers.shape[1] != width:
            raise ValueError(f"its points must be rows of {width} numbers, got rows of {numbers.shape[1]}")
        blocks.append(numbers[:, places])
        left -= len(some)
    return np.concatenate(blocks)
