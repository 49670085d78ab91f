"""Tensors of an ONNX file that lie in another file, found in the file's bytes without a runtime.

The runtime reads such a file relative to the working directory, outside of what the manifest names and the signature
covers. Only the messages that can hold tensors are opened; numbers, names and shapes are skipped by their lengths.
"""

from __future__ import annotations

import re

from attentionvote.inference.bundles.protobuf_fields import BYTES, fields

_OUTSIDE = "outside"
_NAME = 8  # of a tensor
# onnx.proto: the messages that can hold a tensor, their fields that lead to one, and the two fields of a tensor that
# say where its numbers lie: external_data, and data_location, which is 0 for inside.
_MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse_tensor"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse_tensor", 23: "sparse_tensor"},
    "sparse_tensor": {1: "tensor", 2: "tensor"},
    "tensor": {13: _OUTSIDE, 14: _OUTSIDE},
}
# What the tags of such fields begin with, however long they are written. Most nodes and attributes have no such bytes
# and need not be read, which saves a third of the time.
_OUTSIDE_TAG = re.compile(rb"[\x6a\xea\x70\xf0]")
_TAGS = {
    "node": (re.compile(rb"[\x2a\xaa]"), _OUTSIDE_TAG),
    "attribute": (re.compile(rb"[\x2a\xaa\x32\xb2\x52\xd2\x5a\xda\xba]"), _OUTSIDE_TAG),
}
_MOST_DEPTH = 100  # of messages in messages, as the runtime's own reader has it
_MOST_FIELDS = 1_000_000  # the connecting rod's graph has some thousands
_RUNTIME_MAGIC = b"ORTM"


def external_tensor(model: bytes) -> str | None:
    """The name of the first tensor whose numbers lie outside the file; None when all of them are inside.

    Raises:
        ValueError: when the bytes are no ONNX file, or one that is too large to be looked through.
    """
    if model[4:8] == _RUNTIME_MAGIC:  # the runtime would read it by rules of its own
        raise ValueError("it is in onnxruntime's own format")
    pending = [("model", 0, len(model), 1)]
    count = 0
    while pending:
        kind, start, end, depth = pending.pop()
        if depth > _MOST_DEPTH:
            raise ValueError(f"its messages are nested more than {_MOST_DEPTH} deep")
        inner = _MESSAGES[kind]
        for number, wire, first, last in fields(model, start, end):
            count += 1
            if count > _MOST_FIELDS:
                raise ValueError(f"it has more than {_MOST_FIELDS} fields")
            if number not in inner:
                continue
            kind = inner[number]
            if kind == _OUTSIDE:
                if wire == BYTES or any(byte & 0x7F for byte in model[first:last]):
                    return _name(model, start, end)
            elif wire == BYTES and all(tag.search(model, first, last) for tag in _TAGS.get(kind, ())):
                pending.append((kind, first, last, depth + 1))
    return None


def _name(model: bytes, start: int, end: int) -> str:
    """The name of a tensor."""
    spans = [(first, last) for number, _, first, last in fields(model, start, end) if number == _NAME]
    names = [model[first : min(last, first + 80)] for first, last in spans]
    return names[-1].decode("utf-8", "replace") if names else ""
