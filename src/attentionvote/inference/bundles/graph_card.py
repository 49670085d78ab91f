"""The card inside an exported graph, read from the file's bytes without a runtime.

An ONNX file is a protobuf message; its metadata are the repeated field 14, pairs of key (1) and value (2). Walking
over the fields of the outermost message is enough, the graph itself is skipped by its length. So a bundle can be
checked before the runtime, which is large and parses far more, sees a single byte of it.
"""

from __future__ import annotations

from attentionvote.contract import CARD_KEY
from attentionvote.inference.bundles.protobuf_fields import BYTES, fields

_METADATA, _KEY, _VALUE = 14, 1, 2


def card_text(model: bytes) -> str | None:
    """The text of the card in a graph's metadata; None when it carries none.

    Raises:
        ValueError: when the bytes are no ONNX file.
    """
    text = None
    for field, wire, start, end in fields(model):
        if field != _METADATA or wire != BYTES:
            continue
        entry = {number: model[first:last] for number, kind, first, last in fields(model, start, end) if kind == BYTES}
        if entry.get(_KEY) == CARD_KEY.encode():
            text = entry.get(_VALUE, b"").decode("utf-8")
    return text
