"""The points of a PCD file (Point Cloud Library): ascii, binary, and binary_compressed."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.scans.lzf import decompressed
from attentionvote.inference.scans.number_rows import number_rows

MAGIC = (b"# .PCD", b"VERSION")
_MOST_HEADER_BYTES, _MOST_FIELDS, _MOST_ROW_BYTES = 64 * 1024, 256, 64 * 1024
_MOST_UNPACKED_BYTES = 96 * 1024 * 1024  # 4 million points as doubles
_DATA = re.compile(rb"^DATA[ \t]+(ascii|binary_compressed|binary)[ \t]*\r?\n", re.MULTILINE)
_KINDS = {("F", 4): "f4", ("F", 8): "f8"}


@dataclass(frozen=True)
class _Layout:
    """Names, sizes in bytes, kinds (F, I, U) and repetitions of the fields of a point; number of points; organised?"""

    names: list[str]
    sizes: list[int]
    kinds: list[str]
    counts: list[int]
    points: int
    organised: bool

    @property
    def row_bytes(self) -> int:
        """Bytes of one point."""
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    def offset(self, place: int) -> int:
        """Bytes of a point before a field."""
        return sum(size * count for size, count in zip(self.sizes[:place], self.counts[:place], strict=True))

    def axis(self, name: str) -> tuple[int, str]:
        """Index and numpy type of a coordinate."""
        place = self.names.index(name)
        return place, "<" + _KINDS[self.kinds[place], self.sizes[place]]


def points_from_pcd(content: bytes, most_points: int) -> NDArray[np.float32]:
    """Coordinates ``(P, 3)``; the missing points (NaN) of an organised cloud (more than one row) are left out.

    Raises:
        ValueError: with what is wrong, when the file is no PCD file, damaged or too large.
    """
    data = _DATA.search(content[:_MOST_HEADER_BYTES])
    if data is None:
        raise ValueError("its header must end with DATA ascii, binary or binary_compressed")
    layout = _layout(content[: data.start()].decode("latin-1"), most_points)
    if not layout.points:
        return np.zeros((0, 3), np.float32)
    body, kind = content[data.end() :], data.group(1)
    if kind == b"ascii":
        # A field of several values takes several columns.
        columns = np.cumsum([0, *layout.counts])
        places = [int(columns[layout.axis(name)[0]]) for name in "xyz"]
        points: NDArray[np.floating] = number_rows(body, 0, layout.points, int(columns[-1]), places)
    elif kind == b"binary":
        points = _from_rows(body, layout)
    else:
        points = _from_columns(body, layout)
    with np.errstate(over="ignore", invalid="ignore"):
        cloud = points.astype(np.float32)
    return cloud[~np.isnan(cloud).any(axis=1)] if layout.organised else cloud


def _from_rows(body: bytes, layout: _Layout) -> NDArray[np.floating]:
    if layout.points * layout.row_bytes > len(body):
        raise ValueError(
            f"its header promises {layout.points} points of {layout.row_bytes} bytes, "
            f"but only {len(body)} bytes follow: it is truncated"
        )
    places = {name: layout.axis(name) for name in "xyz"}
    row = np.dtype(
        {
            "names": list(places),
            "formats": [kind for _, kind in places.values()],
            "offsets": [layout.offset(place) for place, _ in places.values()],
            "itemsize": layout.row_bytes,
        }
    )
    rows = np.frombuffer(body, row, layout.points)
    return np.stack([rows[name] for name in "xyz"], axis=-1)


def _from_columns(body: bytes, layout: _Layout) -> NDArray[np.floating]:
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
    if packed > unpacked + unpacked // 16 + 64:  # what no compressor writes, and what would take minutes to unpack
        raise ValueError(f"its {packed} compressed bytes must not be more than the {unpacked} they unpack to")
    axes = [layout.axis(name) for name in "xyz"]
    last = max(place for place, _ in axes)
    needed = layout.points * (layout.offset(last) + layout.sizes[last] * layout.counts[last])
    if needed > _MOST_UNPACKED_BYTES:
        raise ValueError(f"its coordinates must lie within {_MOST_UNPACKED_BYTES} unpacked bytes, got {needed}")
    data = decompressed(body[8 : 8 + packed], needed)
    return np.stack(
        [
            np.frombuffer(data, kind, layout.points * layout.counts[place], layout.points * layout.offset(place))[
                :: layout.counts[place]
            ]
            for place, kind in axes
        ],
        axis=-1,
    )


def _layout(header: str, most_points: int) -> _Layout:
    """What the lines of a header say."""
    said: dict[str, list[str]] = {}
    for line in header.splitlines():
        words = line.split("#")[0].split()
        if words:
            said[words[0]] = words[1:]
    names = said.get("FIELDS", [])
    if not names or len(names) > _MOST_FIELDS:
        raise ValueError(f"its header must name 1 to {_MOST_FIELDS} FIELDS, got {len(names)}")
    sizes, counts = _numbers(said, "SIZE", len(names)), _numbers(said, "COUNT", len(names), [1] * len(names))
    kinds = said.get("TYPE", [])
    if len(kinds) != len(names):
        raise ValueError(f"its header must have a TYPE for each of the {len(names)} fields, got {len(kinds)}")
    width, height = _numbers(said, "WIDTH", 1)[0], _numbers(said, "HEIGHT", 1)[0]
    points = _numbers(said, "POINTS", 1, [width * height])[0]
    if points != width * height:
        raise ValueError(f"its POINTS must be WIDTH x HEIGHT = {width * height}, got {points}")
    if points > most_points:
        raise ValueError(f"it must have at most {most_points} points, got {points}")
    layout = _Layout(names, sizes, kinds, counts, points, height > 1)
    if not 0 < layout.row_bytes <= _MOST_ROW_BYTES:
        raise ValueError(f"its points must have 1 to {_MOST_ROW_BYTES} bytes each, got {layout.row_bytes}")
    for name in "xyz":
        if names.count(name) != 1:
            raise ValueError(f"its FIELDS must hold x, y and z once each, got {' '.join(names)[:80]}")
        place = names.index(name)
        if (kinds[place], sizes[place]) not in _KINDS or counts[place] < 1:
            raise ValueError(f"its field {name} must be F of 4 or 8 bytes, got {kinds[place][:8]} of {sizes[place]}")
    return layout


def _numbers(said: dict[str, list[str]], name: str, count: int, default: list[int] | None = None) -> list[int]:
    words = said.get(name)
    if words is None and default is not None:
        return default
    if not words or len(words) != count or not all(word.isdecimal() and len(word) < 10 for word in words):
        raise ValueError(f"its header must have {count} whole numbers as {name}, got {' '.join(words or [])[:60]!r}")
    return [int(word) for word in words]
