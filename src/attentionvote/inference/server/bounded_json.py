"""JSON from strangers: bounded in size and depth, finite numbers only, every failure one sentence."""

from __future__ import annotations

import json
import re
from typing import Any, NoReturn

import numpy as np

from attentionvote.inference.errors import InputError

MOST_BYTES = 8 * 1024 * 1024
MOST_DEPTH = 16
# A text without its closing quote reaches to the end: if it did not match, the next quote would be tried, and the
# next, in quadratic time.
_STRING = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)', re.DOTALL)
_OPENING, _CLOSING = b"[{", b"]}"


def parse_json(what: str, text: bytes) -> Any:
    """The value of a JSON text.

    Args:
        what: names the text in the sentence, e.g. ``the request``.
        text: UTF-8.

    Raises:
        InputError: when it is too large, too deep, no JSON, or holds NaN or infinity.
    """
    if len(text) > MOST_BYTES:
        raise InputError(
            f"{what} must have at most {MOST_BYTES} bytes of JSON, got {len(text)}: send the tensor as binary data"
        )
    depth = _depth(text)
    if depth > MOST_DEPTH:
        raise InputError(f"{what} must be JSON nested at most {MOST_DEPTH} deep, got {depth}")
    try:
        return json.loads(text.decode("utf-8"), parse_constant=_refuse_constant)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # a digit too many in a number is a ValueError as well
        detail = f"{error.msg} at byte {error.pos}" if isinstance(error, json.JSONDecodeError) else str(error)[:80]
        raise InputError(f"{what} must be JSON in UTF-8, got a text that is not ({detail})") from error


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"numbers must be finite, got {name}")


def _depth(text: bytes) -> int:
    """How deep brackets are nested outside strings."""
    codes = np.frombuffer(_STRING.sub(b"", text), dtype=np.uint8)
    steps = np.isin(codes, np.frombuffer(_OPENING, np.uint8)).astype(np.int8)
    steps -= np.isin(codes, np.frombuffer(_CLOSING, np.uint8)).astype(np.int8)
    steps = steps[steps != 0]
    return int(np.cumsum(steps, dtype=np.int64).max(initial=0))
