"""The header of a .npy file, read without evaluating it as Python, which is what numpy does."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import numpy as np

NPY_MAGIC = b"\x93NUMPY"
_MOST_HEADER_BYTES, _MOST_FIELDS, _MOST_ITEM_BYTES, _MOST_DIMENSIONS = 8192, 256, 64 * 1024, 8
# What numpy and the libraries in other languages write.
_HEADER = re.compile(
    r"""\{\s*['"]descr['"]:\s*(?:['"](?P<type>[<>|=]?[fiu]\d{1,2})['"]|\[(?P<fields>[^\]]*)\]),\s*
    ['"]fortran_order['"]:\s*(?P<fortran>True|False),\s*
    ['"]shape['"]:\s*\((?P<shape>[\d,\s]{0,200})\),?\s*\}\s*""",
    re.VERBOSE,
)
_FIELD = re.compile(
    r"""\s*\(\s*['"](?P<name>[^'"]{0,100})['"]\s*,\s*['"](?P<type>[<>|=]?[fiubSUV]\d{1,4})['"]\s*
    (?:,\s*\((?P<shape>[\d,\s]{0,40})\)\s*)?\)\s*,?""",
    re.VERBOSE,
)


class NpyHeader(NamedTuple):
    """Of a .npy file.

    Attributes:
        dtype: of its values.
        shape: of its array.
        order: "C" or "F", numpy's name of the order of its axes in memory.
        start: byte at which the data begin.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    order: str
    start: int


def npy_header(content: memoryview) -> NpyHeader:
    """The header of a .npy file of numbers, or of records of numbers and texts.

    Raises:
        ValueError: with what is wrong.
    """
    text, start = _text(content)
    match = _HEADER.fullmatch(text)
    if match is None:
        raise ValueError("its .npy header does not describe an array of plain numbers")
    dtype = _plain(match["type"]) if match["type"] else _record(match["fields"])
    shape = _shape(match["shape"])
    if len(shape) > _MOST_DIMENSIONS:
        raise ValueError(f"its shape ({match['shape'][:40]}) is impossible")
    return NpyHeader(dtype, shape, "F" if match["fortran"] == "True" else "C", start)


def _text(content: memoryview) -> tuple[str, int]:
    """The header's text and where the data begin."""
    if content[:6] != NPY_MAGIC or len(content) < 12:
        raise ValueError("it has no .npy header")
    layout, first = ("<H", 10) if content[6] == 1 else ("<I", 12)
    (length,) = struct.unpack_from(layout, content, 8)
    if content[6] not in (1, 2, 3) or length > _MOST_HEADER_BYTES or first + length > len(content):
        raise ValueError("its .npy header is damaged")
    return bytes(content[first : first + length]).decode("latin-1"), first + length


def _plain(code: str) -> np.dtype:
    try:
        return np.dtype(code)
    except TypeError as error:
        raise ValueError(f"its values must be numbers of a usual size, got {code}") from error


def _record(fields: str) -> np.dtype:
    """The type of a record; numpy writes a padding field for gaps."""
    columns: list[tuple[str, np.dtype, tuple[int, ...]]] = []
    at = size = 0
    while at < len(fields) and not fields[at:].isspace():
        match = _FIELD.match(fields, at)
        if match is None or len(columns) == _MOST_FIELDS:
            raise ValueError("its .npy header does not describe an array of plain numbers")
        dtype, repeated = _plain(match["type"]), _shape(match["shape"]) if match["shape"] else ()
        if any(length > _MOST_ITEM_BYTES for length in repeated) or len(repeated) > 2:
            raise ValueError("its .npy header does not describe an array of plain numbers")
        columns.append((match["name"] or f"padding {at}", dtype, repeated))
        size += dtype.itemsize * int(np.prod(repeated, dtype=np.int64))
        at = match.end()
    if not 0 < size <= _MOST_ITEM_BYTES or len({name for name, _, _ in columns}) != len(columns):
        raise ValueError(f"its fields must have different names and 1 to {_MOST_ITEM_BYTES} bytes, got {fields[:60]}")
    return np.dtype(columns)


def _shape(text: str) -> tuple[int, ...]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() and len(word) < 16 for word in words[:-1]) or not (words[-1] + "0").isdecimal():
        raise ValueError(f"its shape ({text[:40]}) is impossible")
    return tuple(int(word) for word in words if word)
