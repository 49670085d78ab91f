"""What nobody refers to as tables for people, and as the JSON line."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attentionvote.command.tables import show_table
from attentionvote.workflows.prune.findings import KINDS, Unreferenced

log = logging.getLogger("attentionvote.prune")


def amount(size: int) -> str:
    """Bytes for people."""
    value, unit = float(size), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


def show(things: Sequence[Unreferenced], unfinished: Sequence[Unreferenced], freed: Sequence[Unreferenced]) -> None:
    """Two tables on stderr: every thing, and sums by kind with what is freed."""
    from rich.markup import escape

    listed = [*things, *unfinished]
    rows = [(t.kind, escape(t.part), escape(str(t.path)), f"{t.age_days:.1f}", amount(t.bytes)) for t in listed]
    if not rows:
        log.info("there is nothing that nobody refers to")
        return
    show_table(("kind", "part", "where", "days old", "size"), rows, numbers=("days old", "size"))
    sums = [(kind, [t for t in listed if t.kind == kind]) for kind in (*KINDS, "unfinished")]
    groups = [(kind, group) for kind, group in sums if group] + [("total", listed)]
    paths = {thing.path for thing in freed}
    cells = [
        (kind, str(len(group)), _sum(group), _sum([t for t in group if t.path in paths])) for kind, group in groups
    ]
    columns = ("kind", "number", "size", "freed")
    show_table(columns, cells, "nobody refers to these", numbers=columns[1:])


def result(
    things: Sequence[Unreferenced], unfinished: Sequence[Unreferenced], freed: Sequence[Unreferenced],
    gone: set[Path], unjudged: Sequence[str], removed: bool,
) -> dict[str, Any]:  # fmt: skip
    """The dictionary of the JSON line.

    Args:
        things, unfinished: that nobody refers to; trainings that are only listed.
        freed: those that go, or would go.
        gone: what was removed.
        unjudged: sentences about what could not be judged.
        removed: whether anything was to be removed.
    """
    return {
        "stage": "prune",
        "unreferenced": [thing.as_dict(thing.path in gone) for thing in things],
        "unfinished": [thing.as_dict(False) for thing in unfinished],
        "unjudged": list(unjudged),
        "bytes": sum(thing.bytes for thing in freed),
        "removed": removed,
    }


def _sum(things: Sequence[Unreferenced]) -> str:
    return amount(sum(thing.bytes for thing in things))
