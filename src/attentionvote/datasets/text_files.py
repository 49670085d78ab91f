"""JSON, CSV and parameter files of the formats, opened with one sentence when they cannot be."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def read_text(path: Path) -> str:
    """The content of a text file.

    Raises:
        ValueError: with one sentence, when it is missing or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"{path}: the file cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: the file must be text, got other bytes") from error


def read_json(path: Path, kind: type) -> Any:
    """The content of a JSON file that holds a ``kind`` (dict or list).

    Raises:
        ValueError: with one sentence, when it is missing, not JSON, something else, or says something twice.
    """
    text = read_text(path)
    try:
        content = json.loads(text, object_pairs_hook=_each_once)
    except _Repeated as error:
        raise ValueError(f"{path}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: the file must be JSON, got {error}") from error
    if not isinstance(content, kind):
        raise ValueError(f"{path}: the file must hold a JSON {kind.__name__}, got {type(content).__name__}")
    return content


class _Repeated(ValueError):
    """An object has a key more than once."""


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        key, count = Counter(key for key, _ in pairs).most_common(1)[0]
        raise _Repeated(f"a JSON object must have every key once, got {key!r} {count} times")
    return content


def number(path: Path, values: Mapping[str, Any], key: str) -> float:
    """A finite number of a mapping.

    Raises:
        ValueError: with one sentence naming the file, when there is none.
    """
    if key not in values:
        raise ValueError(f"{path}: the key {key} must be there, got only {', '.join(sorted(map(str, values)))}")
    try:
        value = float(values[key])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}: {key} must be a finite number, got {values[key]!r}")
    return value
