"""Rows of numbers in a text: the ascii forms of the point cloud formats.

``scan_bytes.c`` reads them where it is compiled, Python elsewhere. Both give float32(float64(number)), bit for bit, and
accept the same: what ``float`` accepts, but for underscores. Lines end with LF, CR or both; empty ones are no rows.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import native
from attentionvote.inference.scans.limits import BLOCK_ROWS, MIB, Budget

_MOST_FIELD_BYTES = 320  # of a number; as scan_bytes.c
_MOST_UNDECIDED = 4096
_STOP_BYTES = 4 * MIB
_PIECE_BYTES = 64 * 1024
_NOTHING = (-1, -1, -1)
# Zeros pad some writers' files to whole blocks.
_PADDING = b"\0 \t\r\n\v\f"


@dataclass(frozen=True)
class RowLayout:
    """What a row of a text looks like.

    Args:
        width: fields of a row; 0: any number of them.
        columns: indices of the fields of x, y and z.
        mark: what separates fields, a comma or a semicolon; empty: blanks.
    """

    width: int
    columns: Sequence[int]
    mark: bytes = b""


def number_rows(
    text: memoryview, skip: int, count: int, layout: RowLayout, budget: Budget
) -> tuple[NDArray[np.float32], int]:
    """Three columns ``(count, 3)`` of the rows of a text, and where the text goes on behind them.

    Args:
        text: lines of fields.
        skip: rows, of anything, before the first one wanted.
        count: rows wanted.
        layout: of a wanted row.
        budget: the result's bytes are taken from it.

    Raises:
        ValueError: with what is wrong, when there are fewer rows, or one has other fields than that.
    """
    # A number and its separator have two bytes: a count that cannot be is refused before anything is reserved for it.
    if 2 * (skip + count * max(layout.width, 3)) > len(text) + 2:
        raise ValueError(f"its header promises {count} points, but only {len(text)} bytes follow: it is truncated")
    budget.take(12 * count)
    rows = np.empty((count, 3), np.float32)
    reader = _reader(text, budget)
    reader.read(skip, RowLayout(0, _NOTHING), None)
    done = reader.read(count, layout, rows)
    if done < count:
        raise ValueError(f"its header promises {count} points, but only {done} follow: it is truncated")
    return rows, reader.at


def all_number_rows(text: memoryview, layout: RowLayout, budget: Budget) -> NDArray[np.float32]:
    """Three columns ``(P, 3)`` of all rows of a text.

    Raises:
        ValueError: with what is wrong, when a row has other fields than the layout's.
    """
    most = min(_most_lines(text, budget), len(text) // 6 + 1)  # the shortest row is "0 0 0" and its end
    budget.take(12 * most)
    rows = np.empty((most, 3), np.float32)
    return rows[: _reader(text, budget).read(most, layout, rows)]


def anything_behind(content: memoryview, at: int, budget: Budget) -> bool:
    """Whether something but blanks and zeros follows a byte of a file.

    Raises:
        ValueError: when the budget's time is spent.
    """
    for start in range(at, len(content), MIB):
        budget.check_time()
        if bytes(content[start : start + MIB]).strip(_PADDING):
            return True
    return False


def _most_lines(text: memoryview, budget: Budget) -> int:
    count = 1
    for start in range(0, len(text), MIB):
        budget.check_time()
        piece = np.frombuffer(text[start : start + MIB], np.uint8)
        count += int(np.count_nonzero(piece == 10)) + int(np.count_nonzero(piece == 13))
    return count


def _refuse(layout: RowLayout, fields: int) -> NoReturn:
    """The sentence about a row that has ``fields`` fields, or something that is no number."""
    if fields != layout.width:
        raise ValueError(f"its points must be rows of {layout.width} numbers, got rows of {fields}")
    raise ValueError(f"its points must be rows of {layout.width} numbers, got something else")


class _RowsByC:
    """Reads rows with the compiled code; ``at`` is the first byte that was not read."""

    def __init__(self, library: ctypes.CDLL, text: memoryview, budget: Budget) -> None:
        self._library, self._text, self._budget = library, text, budget
        self._bytes, self.at = np.frombuffer(text, np.uint8), 0

    def read(self, count: int, layout: RowLayout, out: NDArray[np.float32] | None) -> int:
        """Read up to ``count`` rows; how many there were."""
        columns = np.array(layout.columns, np.int64)
        undecided, state = np.empty((_MOST_UNDECIDED, 4), np.int64), np.array([self.at, 0, 0, 0, 0], np.int64)
        target = out if out is not None else np.empty((1, 3), np.float32)
        mark, long = ord(layout.mark or b"\0"), native.long
        done = 0
        while done < count and state[0] < len(self._bytes):
            self._budget.check_time()
            rest = target[done:] if out is not None else target
            most = native.long(min(count - done, BLOCK_ROWS))
            native.call(
                *(self._library.number_rows, self._bytes, long(len(self._bytes)), long(layout.width), columns, mark),
                *(most, long(_STOP_BYTES), rest, undecided, long(_MOST_UNDECIDED), state),
            )
            if state[2]:
                _refuse(layout, int(state[3]))
            for row, axis, start, end in undecided[: state[4]].tolist():
                with np.errstate(over="ignore"):
                    rest[row, axis] = np.float64(float(bytes(self._text[start:end])))
            done += int(state[1])
        self.at = int(state[0])
        return done


class _RowsByPython:
    """The same in Python, for where nothing is compiled, and to compare with."""

    def __init__(self, text: memoryview, budget: Budget) -> None:
        self._text, self._budget, self.at = text, budget, 0

    def read(self, count: int, layout: RowLayout, out: NDArray[np.float32] | None) -> int:
        """Read up to ``count`` rows; how many there were."""
        done = 0
        if not count:
            return 0
        for lines in self._pieces():
            values: list[tuple[float, ...]] = []
            for line in lines:
                self.at += len(line)
                if fields := fields_of(line, layout.mark):
                    values.append(_numbers(fields, layout) if out is not None else ())
                    if done + len(values) == count:
                        break
            if out is not None and values:
                with np.errstate(over="ignore"):
                    out[done : done + len(values)] = np.array(values, np.float64)
            done += len(values)
            if done == count:
                break
        return done

    def _pieces(self) -> Iterator[list[bytes]]:
        """Whole lines, with their ends, from the first byte that was not read."""
        start, rest = self.at, b""
        while start < len(self._text):
            self._budget.check_time()
            piece = rest + bytes(self._text[start : start + _PIECE_BYTES])
            start += _PIECE_BYTES
            lines = piece.splitlines(keepends=True)
            # The last line may go on; behind a CR at the very end an LF may follow.
            rest = lines.pop() if start < len(self._text) else b""
            yield lines


def fields_of(line: bytes, mark: bytes) -> list[bytes]:
    """Fields of a line, none of a blank one; a mark may stand behind the last one."""
    if not mark or not line.strip():
        return line.split()
    fields = [field.strip() for field in line.split(mark)]
    return fields if fields[-1] else fields[:-1]


def _numbers(fields: list[bytes], layout: RowLayout) -> tuple[float, ...]:
    if layout.width and len(fields) != layout.width:
        _refuse(layout, len(fields))
    wanted = [fields[column] for column in layout.columns]
    if any(len(field) > _MOST_FIELD_BYTES or b"_" in field for field in wanted):
        _refuse(layout, layout.width)
    try:
        return tuple(map(float, wanted))
    except ValueError:
        _refuse(layout, layout.width)


def _reader(text: memoryview, budget: Budget) -> _RowsByC | _RowsByPython:
    library = native.load("attentionvote.inference.scans", "scan_bytes.c", make=False)
    return _RowsByPython(text, budget) if library is None else _RowsByC(library, text, budget)
