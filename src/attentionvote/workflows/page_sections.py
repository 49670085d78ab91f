"""Sections of a page that are written by measurements, and the records beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attentionvote.files import read_json, write_whole


def put(page: Path, name: str, text: str, writer: str = "make benchmark") -> None:
    """Write a section between its marks, or at the end of the page; whole or not at all.

    Args:
        page: other sections of it, and what is written by hand, stay.
        name: of the section.
        text: of whole lines.
        writer: the command that writes it, for its mark.
    """
    begin, end = f"<!-- {name}: written by {writer} -->", f"<!-- end of {name} -->"
    old = page.read_text(encoding="utf-8") if page.exists() else "# Benchmarks\n"
    section = f"{begin}\n{text}{end}\n"
    if begin in old and end in old.partition(begin)[2]:
        before, _, rest = old.partition(begin)
        new = before + section + rest.partition(end)[2].lstrip(" ").removeprefix("\n")
    else:
        new = old.rstrip("\n") + "\n\n" + section
    write_whole(page, new)


def record_of(page: Path, name: str) -> Path:
    """The file beside a page that keeps what a section of it is written from."""
    return page.with_suffix("") / f"{name}.json"


def stored_beside(page: Path, name: str, key: str, writer: str = "make benchmark") -> Any:
    """What earlier calls kept for a section under a key; None before the first.

    Raises:
        ValueError: when the file is damaged: the page would lose what it shows.
    """
    path = record_of(page, name)
    stored = (read_json(path) or {}).get(key)
    if stored is None and path.exists():
        raise ValueError(f"{path} must be what `{writer}` wrote, got a damaged file: mend or remove it")
    return stored
