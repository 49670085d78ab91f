"""The points of a PCD file (Point Cloud Library): ascii, binary, and binary_compressed."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.limits import MOST_UNPACKED_BYTES, Budget
from attentionvote.inference.scans.lzf import decompressed
from attentionvote.inference.scans.missing_points import cloud_of, mark_missing
from attentionvote.inference.scans.number_rows import RowLayout, anything_behind, number_rows
from attentionvote.inference.scans.viewpoint import in_camera_frame, viewpoint_pose

MAGIC = (b"# .PCD", b"VERSION")
_MOST_HEADER_BYTES, _MOST_FIELDS, _MOST_ROW_BYTES = 64 * 1024, 256, 64 * 1024
_DATA = re.compile(rb"^DATA[ \t]+(ascii|binary_compressed|binary)[ \t]*\r?\n", re.MULTILINE)
_DATA_CR = re.compile(rb"(?<=\r)DATA[ \t]+(ascii|binary_compressed|binary)[ \t]*\r")
_KINDS = {("F", 4): "f4", ("F", 8): "f8"}


@dataclass(frozen=True)
class _Layout:
    """Names (in small letters), sizes in bytes, kinds (F, I, U) and repetitions of the fields of a point.

    Attributes:
        width, height: of the organised cloud; a height of 1: a list of points.
        viewpoint: words of the sensor's pose in the cloud's frame.
    """

    names: list[str]
    sizes: list[int]
    kinds: list[str]
    counts: list[int]
    width: int
    height: int
    viewpoint: list[str]

    @property
    def points(self) -> int:
        """Number of points."""
        return self.width * self.height

    @property
    def row_bytes(self) -> int:
        """Bytes of one point."""
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    def offset(self, index: int) -> int:
        """Bytes of a point before a field."""
        return sum(size * count for size, count in zip(self.sizes[:index], self.counts[:index], strict=True))

    def axis(self, name: str) -> tuple[int, str]:
        """Index and numpy type of a coordinate."""
        index = self.names.index(name)
        return index, "<" + _KINDS[self.kinds[index], self.sizes[index]]


def points_from_pcd(content: memoryview, budget: Budget) -> NDArray[np.float32]:
    """Coordinates ``(P, 3)``, of an organised cloud (more than one row) ``(H, W, 3)``, missing points NaN.

    They are in the frame of the sensor: the file's VIEWPOINT is applied.

    Raises:
        ValueError: with what is wrong, when the file is no PCD file, damaged, or costs more than the budget.
    """
    head = bytes(content[:_MOST_HEADER_BYTES])
    # A file whose lines end with CR alone is told by its first line: the first byte of its data may be an LF.
    data = (_DATA_CR if re.match(rb"[^\r\n]*\r(?!\n)", head) else _DATA).search(head)
    if data is None:
        raise ValueError("its header must end with DATA ascii, binary or binary_compressed")
    layout = _layout(head[: data.start()].decode("latin-1"))
    viewpoint = viewpoint_pose(layout.viewpoint)
    read = {b"ascii": _from_text, b"binary": _from_rows, b"binary_compressed": _from_columns}[data.group(1)]
    empty = np.zeros((0, 3), np.float32), 0
    cloud, end = read(content[data.end() :], layout, budget) if layout.points else empty
    if anything_behind(content, data.end() + end, budget):
        raise ValueError(f"its header promises {layout.points} points, but more follows them: mend POINTS and WIDTH")
    in_camera_frame(cloud, viewpoint, budget)
    return cloud.reshape(layout.height, layout.width, 3) if layout.height > 1 else cloud


def _from_text(body: memoryview, layout: _Layout, budget: Budget) -> tuple[NDArray[np.float32], int]:
    """The cloud and where the body goes on behind it."""
    columns = np.cumsum([0, *layout.counts])  # a field of several values takes several columns
    rows = RowLayout(int(columns[-1]), [int(columns[layout.axis(name)[0]]) for name in "xyz"])
    cloud, end = number_rows(body, 0, layout.points, rows, budget)
    mark_missing(cloud)
    return cloud, end


def _from_rows(body: memoryview, layout: _Layout, budget: Budget) -> tuple[NDArray[np.float32], int]:
    """The cloud and where the body goes on behind it."""
    size = layout.points * layout.row_bytes
    if size > len(body):
        raise ValueError(
            f"its header promises {layout.points} points of {layout.row_bytes} bytes, "
            f"but only {len(body)} bytes follow: it is truncated"
        )
    axes = {name: layout.axis(name) for name in "xyz"}
    row = np.dtype(
        {
            "names": list(axes),
            "formats": [kind for _, kind in axes.values()],
            "offsets": [layout.offset(index) for index, _ in axes.values()],
            "itemsize": layout.row_bytes,
        }
    )
    rows = np.frombuffer(body, row, layout.points)
    return cloud_of([rows[name] for name in "xyz"], budget), size


def _from_columns(body: memoryview, layout: _Layout, budget: Budget) -> tuple[NDArray[np.float32], int]:
    """Compressed data are stored field by field, so nothing behind the last coordinate needs to be unpacked."""
    if len(body) < 8:
        raise ValueError("it ends before its compressed points")
    packed, unpacked = (int(n) for n in np.frombuffer(body, "<u4", 2))
    if unpacked != layout.points * layout.row_bytes:
        raise ValueError(
            f"its compressed points must unpack to {layout.points * layout.row_bytes} bytes, its header says {unpacked}"
        )
    if packed > len(body) - 8:
        raise ValueError(f"it promises {packed} compressed bytes, but only {len(body) - 8} follow: it is truncated")
    if packed > unpacked + unpacked // 16 + 64:  # what no compressor writes
        raise ValueError(f"its {packed} compressed bytes must not be more than the {unpacked} they unpack to")
    axes = [layout.axis(name) for name in "xyz"]
    last = max(index for index, _ in axes)
    needed = layout.points * (layout.offset(last) + layout.sizes[last] * layout.counts[last])
    if needed > MOST_UNPACKED_BYTES:
        raise ValueError(f"its coordinates must lie within {MOST_UNPACKED_BYTES} unpacked bytes, got {needed}")
    data = decompressed(body[8 : 8 + packed], needed, budget)
    columns = [
        np.frombuffer(data, kind, layout.points * layout.counts[index], layout.points * layout.offset(index))[
            :: layout.counts[index]
        ]
        for index, kind in axes
    ]
    return cloud_of(columns, budget), 8 + packed


def _layout(header: str) -> _Layout:
    """What the lines of a header say."""
    entries: dict[str, list[str]] = {}
    for line in header.splitlines():
        words = line.split("#")[0].split()
        if words:
            entries[words[0]] = words[1:]
    names = [name.lower() for name in entries.get("FIELDS", [])]
    if not names or len(names) > _MOST_FIELDS:
        raise ValueError(f"its header must name 1 to {_MOST_FIELDS} FIELDS, got {len(names)}")
    sizes, counts = _numbers(entries, "SIZE", len(names)), _numbers(entries, "COUNT", len(names), [1] * len(names))
    kinds = entries.get("TYPE", [])
    if len(kinds) != len(names):
        raise ValueError(f"its header must have a TYPE for each of the {len(names)} fields, got {len(kinds)}")
    width, height = _numbers(entries, "WIDTH", 1)[0], _numbers(entries, "HEIGHT", 1)[0]
    points = _numbers(entries, "POINTS", 1, [width * height])[0]
    if points != width * height:
        raise ValueError(f"its POINTS must be WIDTH x HEIGHT = {width * height}, got {points}")
    layout = _Layout(names, sizes, kinds, counts, width, height, entries.get("VIEWPOINT", []))
    if not 0 < layout.row_bytes <= _MOST_ROW_BYTES:
        raise ValueError(f"its points must have 1 to {_MOST_ROW_BYTES} bytes each, got {layout.row_bytes}")
    for name in "xyz":
        if names.count(name) != 1:
            raise ValueError(f"its FIELDS must hold x, y and z once each, got {' '.join(names)[:80]}")
        index = names.index(name)
        if (kinds[index], sizes[index]) not in _KINDS or counts[index] < 1:
            raise ValueError(f"its field {name} must be F of 4 or 8 bytes, got {kinds[index][:8]} of {sizes[index]}")
    return layout


def _numbers(entries: dict[str, list[str]], name: str, count: int, default: list[int] | None = None) -> list[int]:
    words = entries.get(name)
    if words is None and default is not None:
        return default
    if not words or len(words) != count or not all(word.isdecimal() and len(word) < 10 for word in words):
        raise ValueError(f"its header must have {count} whole numbers as {name}, got {' '.join(words or [])[:60]!r}")
    return [int(word) for word in words]
