"""The page of the verb bench: what was measured, when and where, what was not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from attentionvote.workflows.speed.report import keep, markdown, stored_rows


def measured(met: bool | None, commit: str, **changes: Any) -> dict[str, Any]:
    """A row as ``bench_row.measure`` gives it, with the facts of its run."""
    run = {
        "commit": commit, "hardware": {"cpu": "CPU", "cores": "2", "memory_gib": "24.0", "gpu": "none"},
        "versions": {"torch": "2.13.0", "numpy": "2.4.6"}, "seed": 0, "rounds": 5, "load": 0.1, "date": "2026-11-28",
    }  # fmt: skip
    references = {"numpy": {"ms": 16_000.0, "factor": 13.21}, "torch": {"ms": 123.4, "factor": 0.5}}
    goals = [{"text": "<= 1.2 x torch"}, {"text": "<= 15 ms"}]
    return {
        "title": "order", "size": "9 points", "ms": 12.53, "item": "call", "clock": "processor, 1 thread",
        "references": references, "absent": ["other"], "goals": goals, "met": met, "equal": "identical", "run": run,
    } | changes  # fmt: skip


def test_rows_of_several_runs_stand_in_one_table() -> None:
    rows = {
        "a": measured(True, "a" * 40),
        "b": measured(False, "b" * 40 + "+dirty"),
        "c": {**measured(None, "a" * 40), "reason": "no GPU here"},
    }
    assert markdown(["a", "b", "c", "d"], rows) == (
        "| row | what | of | ours | beside it | to reach | | equal | run |\n"
        "|---|---|---|---|---|---|---|---|---|\n"
        "| a | order | 9 points | 12.5 ms a call (processor, 1 thread) | numpy 16 s (13.2 x); torch 123 ms (0.5 x); "
        "other not installed | <= 1.2 x torch; <= 15 ms | met | identical | A |\n"
        "| b | order | 9 points | 12.5 ms a call (processor, 1 thread) | numpy 16 s (13.2 x); torch 123 ms (0.5 x); "
        "other not installed | <= 1.2 x torch; <= 15 ms | **not met** | identical | B |\n"
        "| c | order |  | not measured: no GPU here |  | <= 1.2 x torch; <= 15 ms |  |  | A |\n"
        "| d | | | not run | | | | | |\n"
        "\n"
        "Run A: 2026-11-28, commit `aaaaaaaaaaaa`, CPU, 2 cores, 24.0 GiB, GPU none; torch 2.13.0, numpy 2.4.6; "
        "seed 0, medians of 5 rounds, load 0.1 at the start.\n"
        "Run B: 2026-11-28, commit `bbbbbbbbbbbb+dirty`, CPU, 2 cores, 24.0 GiB, GPU none; torch 2.13.0, numpy 2.4.6; "
        "seed 0, medians of 5 rounds, load 0.1 at the start.\n"
    )


def test_what_was_measured_is_kept_beside_the_page(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "page.md"
    assert stored_rows(page) == {}
    keep(page, {"a": {"ms": 1.0}})
    assert stored_rows(page) == {"a": {"ms": 1.0}}
    (page.with_suffix("") / "speed.json").write_text("{")
    with pytest.raises(ValueError, match="must be what `make bench` wrote, got a damaged file: mend or remove it"):
        stored_rows(page)
    assert (tmp_path / "docs" / "page" / "speed.json").is_file()
