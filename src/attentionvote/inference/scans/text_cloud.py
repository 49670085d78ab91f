"""Clouds as plain text (.xyz, .asc, .csv): a point a line, coordinates between blanks, commas or semicolons."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.missing_points import mark_missing
from attentionvote.inference.scans.number_rows import RowLayout, all_number_rows, fields_of

_MOST_HEAD_BYTES, _MOST_HEAD_LINES, _MOST_FIELDS = 64 * 1024, 256, 256
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_DECIMAL_COMMAS = re.compile(rb"[-+0-9.,;eE\s]+")
_TEXT = re.compile(rb"[\t\v\f\x20-\x7e\x80-\xff]*")
_COMMENTS = (b"#", b"//")


def text_rows_start(content: memoryview) -> tuple[int, RowLayout] | None:
    """Where the rows of a text of numbers begin, and what they look like; None when it is no such text.

    Before the rows there may be comments (``#``, ``//``) and one other line: names, or a number of points.

    Raises:
        ValueError: when the numbers have decimal commas.
    """
    head = bytes(content[:_MOST_HEAD_BYTES])
    at = len(_BYTE_ORDER_MARK) if head.startswith(_BYTE_ORDER_MARK) else 0
    lines = head[at:].splitlines(keepends=True)
    if len(head) < len(content) and lines:
        lines.pop()  # may be cut
    header, names = b"", 0
    for line in lines[:_MOST_HEAD_LINES]:
        words = line.strip()
        if not _TEXT.fullmatch(words):
            return None
        if not words or words.startswith(_COMMENTS):
            header = words.lstrip(b"#/ ") or header
        elif (layout := _row_layout(words, header)) is not None:
            return at, layout
        else:
            header, names = words, names + 1
            if names > 1:
                return None
        at += len(line)
    return None


def points_from_text(content: memoryview, start: int, layout: RowLayout, budget: Budget) -> NDArray[np.float32]:
    """Coordinates ``(P, 3)`` of the rows from a byte on, missing ones NaN.

    Raises:
        ValueError: with what is wrong, when a row has other fields than the layout's, or the budget is spent.
    """
    cloud = all_number_rows(content[start:], layout, budget)
    mark_missing(cloud)
    return cloud


def _row_layout(line: bytes, header: bytes) -> RowLayout | None:
    """What a row of numbers looks like; None when the line is none."""
    mark = next((mark for mark in (b";", b",") if mark in line), b"")
    fields = fields_of(line, mark)
    mixed = b"," in line and (mark == b";" or any(b" " in field or b"\t" in field for field in fields))
    if mixed and _DECIMAL_COMMAS.fullmatch(line):
        raise ValueError("its numbers must have decimal points, got commas: write 0.5, not 0,5")
    if not 3 <= len(fields) <= _MOST_FIELDS:
        return None
    columns = _columns(fields_of(header, mark), len(fields))
    return RowLayout(len(fields), columns, mark) if all(_NUMBER.fullmatch(fields[c]) for c in columns) else None


def _columns(names: list[bytes], width: int) -> list[int]:
    """Where x, y and z stand by the names of a header, else the first three."""
    plain = [name.strip(b"\"' ").lower() for name in names]
    if len(plain) == width and all(plain.count(axis) == 1 for axis in (b"x", b"y", b"z")):
        return [plain.index(axis) for axis in (b"x", b"y", b"z")]
    return [0, 1, 2]
