"""The figures of the verb score as a table on stderr."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

COLUMNS = {
    "sileane": ("ap", "f1", "map", "r99", "r50", "tp", "fp", "fn"),
    "bop": ("map", "map_mm", "targets", "estimates"),
}
ROWS = {"sileane": "per_scene", "bop": "per_object"}


def show(result: Mapping[str, Any]) -> None:
    """One row a scene (Sileane) or an object (BOP), and one of all together."""
    from rich.console import Console
    from rich.table import Table

    kind = str(result["format"])
    table = Table(title=_title(result), title_justify="left", box=None, pad_edge=False)
    table.add_column(ROWS[kind].removeprefix("per_"))
    for name in COLUMNS[kind]:
        table.add_column(name, justify="right")
    overall = {"map": result["bop25_mAP"], "map_mm": result["bop25_mAP_mm"]} if kind == "bop" else {}
    rows = {**result[ROWS[kind]], "all": {**result, **overall}}
    for name, figures in rows.items():
        table.add_row(str(name), *(_shown(figures[column]) for column in COLUMNS[kind]))
    Console(stderr=True).print(table)


def _title(result: Mapping[str, Any]) -> str:
    if result["format"] == "bop":
        return f"{result['method']} on {result['dataset']}, {result['images']} images"
    required = "every pose" if result["occlusion"] > 1 else f"poses occluded up to {result['occlusion']:g}"
    frame = "" if result["frame"] == "toolbox" else ", object-side frame"
    return f"{result['scenes']} scenes, threshold {1000 * result['threshold_m']:.4g} mm, {required} required{frame}"


def _shown(value: float | int) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6f}"
