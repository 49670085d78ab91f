"""Small results in JSON files: written whole or not at all, passed over when damaged."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from whole_files import write_whole

log = logging.getLogger("attentionvote.pipelines")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file whole or not at all."""
    write_whole(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file; None when there is no such file, or, with a warning, when it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        content = None
    if not isinstance(content, dict):
        log.warning("%s is damaged and is passed over", path)
        return None
    return content
