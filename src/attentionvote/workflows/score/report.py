"""The figures of the verb score as a table on stderr."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attentionvote.command.tables import show_table

COLUMNS = {
    "sileane": ("ap", "f1", "map", "r99", "r50", "tp", "fp", "fn"),
    "bop": ("map", "map_mm", "targets", "estimates"),
}
ROWS = {"sileane": "per_scene", "bop": "per_object"}


def show(result: Mapping[str, Any]) -> None:
    """One row a scene (Sileane) or an object (BOP), and one of all together."""
    kind = str(result["format"])
    overall = {"map": result["bop25_mAP"], "map_mm": result["bop25_mAP_mm"]} if kind == "bop" else {}
    rows = {**result[ROWS[kind]], "all": {**result, **overall}}
    cells = [(str(name), *(_shown(row[column]) for column in COLUMNS[kind])) for name, row in rows.items()]
    show_table((ROWS[kind].removeprefix("per_"), *COLUMNS[kind]), cells, _title(result), numbers=COLUMNS[kind])


def _title(result: Mapping[str, Any]) -> str:
    if result["format"] == "bop":
        return f"{result['method']} on {result['dataset']}, {result['images']} images"
    required = "every pose" if result["occlusion"] > 1 else f"poses occluded up to {result['occlusion']:g}"
    frame = "" if result["frame"] == "toolbox" else ", object-side frame"
    return f"{result['scenes']} scenes, threshold {1000 * result['threshold_m']:.4g} mm, {required} required{frame}"


def _shown(value: float | int) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6f}"
