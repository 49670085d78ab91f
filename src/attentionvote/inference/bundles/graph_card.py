"""The card inside an exported graph, read from the file's bytes without a runtime.

An ONNX file is a protobuf message; its metadata are the repeated field 14, pairs of key (1) and value (2). Walking
over the fields of the outermost message is enough, the graph itself is skipped by its length. So a bundle can be
checked before the runtime, which is large and parses far more, sees a single byte of it.
"""

from __future__ import annotations

from collections.abc import Iterator

from attentionvote.contract import CARD_KEY

_METADATA, _KEY, _VALUE = 14, 1, 2
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def card_text(model: bytes) -> str | None:
    """The text of the card in a graph's metadata; None when it carries none.

    Raises:
        ValueError: when the bytes are no ONNX file.
    """
    view = memoryview(model)
    found = None
    for field, content in _fields(view):
        if field != _METADATA or content is None:
            continue
        entry = {number: bytes(value) for number, value in _fields(content) if value is not None}
        if entry.get(_KEY) == CARD_KEY.encode():
            found = entry.get(_VALUE, b"").decode("utf-8")
    return found


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | None]]:
    """Number and content of every field of a message; content is None for numbers, whose values nobody needs here."""
    at, end = 0, len(message)
    while at < end:
        tag, at = _varint(message, at)
        number, wire = tag >> 3, tag & 7
        size = 0
        if wire == _VARINT:
            _, at = _varint(message, at)
        elif wire in (_FIXED64, _FIXED32):
            size = 8 if wire == _FIXED64 else 4
        elif wire == _BYTES:
            size, at = _varint(message, at)
        else:
            raise ValueError(f"wire type {wire} does not occur in ONNX files")
        if number == 0 or size > end - at:
            raise ValueError("a field leaves the message")
        yield number, message[at : at + size] if wire == _BYTES else None
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of variable length and where it ends."""
    value = 0
    for i in range(10):
        if at + i >= len(message):
            raise ValueError("the message ends within a number")
        byte = message[at + i]
        value |= (byte & 0x7F) << (7 * i)
        if byte < 0x80:
            return value, at + i + 1
    raise ValueError("a number has more than ten bytes")
