"""The fields of a protobuf message, read from its bytes without a schema and without copies."""

from __future__ import annotations

from collections.abc import Iterator

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
_LARGEST_NUMBER = (1 << 29) - 1  # of a field; readers differ in what a larger one is


def fields(content: bytes, start: int = 0, end: int | None = None) -> Iterator[tuple[int, int, int, int]]:
    """The fields of the message ``content[start:end]``: number, wire type, start and end of what each one holds.

    Raises:
        ValueError: when the bytes are no message.
    """
    end = len(content) if end is None else end
    at = start
    while at < end:
        tag = content[at]
        if tag < 0x80:  # nearly all of them: a call for each would double the time
            at += 1
        else:
            tag, at = _varint(content, at, end)
        number, wire = tag >> 3, tag & 7
        first = at
        if wire == BYTES:
            if at < end and content[at] < 0x80:
                first = at + 1
                at = first + content[at]
            else:
                size, first = _varint(content, at, end)
                at = first + size
        elif wire == VARINT:
            if at < end and content[at] < 0x80:
                at += 1
            else:
                _, at = _varint(content, at, end)
        elif wire in (FIXED64, FIXED32):
            at += 8 if wire == FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire} does not occur in ONNX files")
        if not 0 < number <= _LARGEST_NUMBER or at > end:
            raise ValueError("a field leaves the message")
        yield number, wire, first, at


def _varint(content: bytes, at: int, end: int) -> tuple[int, int]:
    """A number of variable length and where it ends."""
    value = 0
    for i in range(10):
        if at + i >= end:
            raise ValueError("the message ends within a number")
        byte = content[at + i]
        value |= (byte & 0x7F) << (7 * i)
        if byte < 0x80:
            return value, at + i + 1
    raise ValueError("a number has more than ten bytes")
