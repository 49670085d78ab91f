"""The vertices of a PLY file: ascii, binary little and big endian. Other properties are skipped, faces are not read."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import Budget
from attentionvote.inference.scans.missing_points import cloud_of, mark_missing
from attentionvote.inference.scans.number_rows import RowLayout, anything_behind, number_rows

MAGIC = (b"ply\n", b"ply\r", b"ply ")
_MOST_HEADER_BYTES, _MOST_LINES = 256 * 1024, 2000
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_END_CR = re.compile(rb"(?<=\r)end_header[ \t]*\r")
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass
class _Element:
    """An element of the header: how many of it there are, its properties' names and types; a list has no type."""

    name: str
    count: int
    properties: dict[str, str | None] = field(default_factory=dict)


def points_from_ply(content: memoryview, budget: Budget) -> NDArray[np.float32]:
    """Coordinates ``(P, 3)`` of the vertices, missing ones NaN.

    Raises:
        ValueError: with what is wrong, when the file is no PLY file, damaged, or costs more than the budget.
    """
    order, elements, start = _header(content)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise ValueError("its header has no element vertex")
    axes = _axes(vertex)
    before, behind = elements[: elements.index(vertex)], elements[elements.index(vertex) + 1 :]
    cloud, end = np.zeros((0, 3), np.float32), start
    if vertex.count:
        read = _from_rows if _FORMATS[order] else _from_text
        cloud, end = read(content, start, order, before, vertex, axes, budget)
    alone = not any(element.count for element in behind) and (vertex.count or not any(e.count for e in before))
    if alone and anything_behind(content, end, budget):
        raise ValueError(f"its header promises {vertex.count} vertices and nothing else, but more follows them")
    return cloud


def _axes(vertex: _Element) -> list[str]:
    """The names of x, y and z, which some write in capitals."""
    axes = []
    for axis in "xyz":
        names = [name for name in vertex.properties if name.lower() == axis]
        if not names:
            raise ValueError(f"its vertices must have x, y and z, got no {axis}")
        if len(names) > 1:
            raise ValueError(f"its vertices must have {axis} once, got {' and '.join(names)}")
        axes += names
    return axes


def _from_rows(
    content: memoryview,
    start: int,
    order: str,
    before: list[_Element],
    vertex: _Element,
    axes: list[str],
    budget: Budget,
) -> tuple[NDArray[np.float32], int]:
    """The cloud and where the file goes on behind it."""
    for element in before:
        start += element.count * _row(element, order).itemsize
    row = _row(vertex, order)
    there = max(len(content) - start, 0)
    if vertex.count * row.itemsize > there:
        raise ValueError(
            f"its header promises {vertex.count} vertices of {row.itemsize} bytes, "
            f"but only {there} bytes follow: it is truncated"
        )
    rows = np.frombuffer(content, row, vertex.count, start)
    return cloud_of([rows[axis] for axis in axes], budget), start + vertex.count * row.itemsize


def _from_text(
    content: memoryview,
    start: int,
    _: str,
    before: list[_Element],
    vertex: _Element,
    axes: list[str],
    budget: Budget,
) -> tuple[NDArray[np.float32], int]:
    """The cloud and where the file goes on behind it."""
    if None in vertex.properties.values():
        raise ValueError("its vertices must have no list property")
    layout = RowLayout(len(vertex.properties), [list(vertex.properties).index(axis) for axis in axes])
    skip = sum(element.count for element in before)
    cloud, end = number_rows(content[start:], skip, vertex.count, layout, budget)
    mark_missing(cloud)
    return cloud, start + end


def _row(element: _Element, order: str) -> np.dtype:
    """The layout of one row of an element in a binary file."""
    if None in element.properties.values():
        raise ValueError(f"its element {element.name} must have no list property unless it follows the vertices")
    kinds = [(name, _FORMATS[order] + str(kind)) for name, kind in element.properties.items()]
    return np.dtype(kinds)


def _header(content: memoryview) -> tuple[str, list[_Element], int]:
    """Format, elements, and where the data begin."""
    head = bytes(content[:_MOST_HEADER_BYTES])
    # A file whose lines end with CR alone is told by its first line: the first byte of its data may be an LF.
    end = (_END_CR if re.match(rb"ply[ \t]*\r(?!\n)", head) else _END).search(head)
    if end is None:
        raise ValueError("its header has no end_header")
    lines = head[: end.start()].decode("latin-1").splitlines()
    if len(lines) > _MOST_LINES:
        raise ValueError(f"its header must have at most {_MOST_LINES} lines, got {len(lines)}")
    order = ""
    elements: list[_Element] = []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _FORMATS:
            order = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            _add(elements[-1], words[2], _TYPES[words[1]])
        elif words[:2] == ["property", "list"] and elements and len(words) == 5:
            _add(elements[-1], words[4], None)
        else:
            raise ValueError(f"its header has the line {line[:60]!r}, which no PLY header has")
    if not order:
        raise ValueError(f"its header must name a format, one of {', '.join(_FORMATS)}")
    return order, elements, end.end()


def _add(element: _Element, name: str, kind: str | None) -> None:
    if name in element.properties:
        raise ValueError(f"its element {element.name} has the property {name[:40]!r} twice")
    element.properties[name] = kind
