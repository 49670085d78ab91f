"""What was measured of a table is kept beside its page, and comes back with a clone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from attentionvote.command.configuration import compose
from attentionvote.workflows.page_sections import put
from attentionvote.workflows.tables.cells import CellFailed, cells_of_parts
from attentionvote.workflows.tables.page import markdown
from attentionvote.workflows.tables.record import BenchmarkRecord
from attentionvote.workflows.tables.settings import TablesSettings
from attentionvote.workflows.tables.table import BenchmarkTable

DOCS = Path(__file__).resolve().parents[3] / "docs"


def test_cells_of_earlier_calls_are_there_and_replaced_one_by_one(tmp_path: Path) -> None:
    page = str(tmp_path / "docs" / "page.md")
    first = BenchmarkRecord.beside(page, "table_0")
    assert first.cells == {}
    first.add("ours", "brick", {"scenes": 3})
    first.add("PPF", "brick", {"scenes": 3})
    second = BenchmarkRecord.beside(page, "table_0")
    second.add("ours", "brick", {"scenes": 4})
    kept = json.loads((tmp_path / "docs" / "page" / "table_0.json").read_text())
    assert kept == {
        "table": "table_0",
        "cells": [{"row": "ours", "object": "brick", "scenes": 4}, {"row": "PPF", "object": "brick", "scenes": 3}],
    }
    assert BenchmarkRecord.beside(page, "table_1").cells == {}


def test_without_a_page_nothing_is_known_and_nothing_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record = BenchmarkRecord.beside("", "table_0")
    record.add("ours", "brick", {"scenes": 3})
    assert record.cells["ours", "brick"]["scenes"] == 3
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_file_is_refused_before_the_page_loses_its_numbers(tmp_path: Path) -> None:
    place = tmp_path / "page" / "table_0.json"
    place.parent.mkdir()
    place.write_text("{")
    with pytest.raises(ValueError, match="must be what `make benchmark` wrote, got a damaged file: mend or remove it"):
        BenchmarkRecord.beside(str(tmp_path / "page.md"), "table_0")


def test_a_bin_of_several_parts_is_a_cell_a_part() -> None:
    cell = {
        "figures": {"ap_10": 0.5, "gear/ap_10": 0.4, "rod/ap_10": 0.6, "latency_p50_ms": 9.0},
        "intervals": {"ap_10": [0.4, 0.6], "rod/ap_10": [0.5, 0.7], "gear/ap_10": [0.3, 0.5]},
        "thresholds": [0.1], "ap_by_threshold": [0.5], "scenes": 7,
    }  # fmt: skip
    assert cells_of_parts(cell, ["rod"]) == {
        "rod": {
            "figures": {"ap_10": 0.6, "latency_p50_ms": 9.0}, "intervals": {"ap_10": [0.5, 0.7]}, "scenes": 7,
        }
    }  # fmt: skip
    assert cells_of_parts(None, ["rod", "gear"]) == {"rod": None, "gear": None}
    with pytest.raises(CellFailed, match="the bin must hold the part brick, got none"):
        cells_of_parts(cell, ["brick"])


@pytest.mark.parametrize("place", sorted((DOCS / "benchmarks").glob("*_*.json")), ids=lambda place: place.stem)
def test_the_projects_page_shows_what_its_files_keep(place: Path, tmp_path: Path) -> None:
    """Nobody has changed a number on the page, or the table, by hand."""
    cfg = compose(TablesSettings, [f"table={place.stem}"])
    table = BenchmarkTable.of(place.stem, cfg.composed["table"])
    cells = BenchmarkRecord.beside(str(DOCS / "benchmarks.md"), table.name).cells
    assert {row for row, _ in cells} <= {row.name for row in table.measured}
    text = (DOCS / "benchmarks.md").read_text(encoding="utf-8")
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    picture = f"images/{table.name}.png" if table.curve else None
    put(tmp_path / "page.md", table.name, markdown(table, cells, picture))
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == text
