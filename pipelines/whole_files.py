"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path


def write_whole(path: Path, text: str) -> None:
    """Write a text; its folder is made."""
    whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline=""))


def whole(path: Path, write: Callable[[Path], object]) -> None:
    """Have ``write`` make a file under another name of the same kind, and give it its own; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
