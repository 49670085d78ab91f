"""The verb bench: small rows really measured, a wrong name, results that differ."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import bench
import pytest

from attentionvote.command.configuration import compose
from attentionvote.command.errors import Refused
from attentionvote.geometry import sampling_reference
from attentionvote.workflows.speed import rows as bench_rows
from attentionvote.workflows.speed.settings import SpeedSettings

ROOT = Path(__file__).resolve().parents[3]
SMALL = ["object=brick", "compact=['experiment=smoke']", "full=['experiment=smoke']", "rounds=2"]
OTHERS = "# Page\n\nby hand\n\n<!-- table_6: written by make benchmark -->\nit\n<!-- end of table_6 -->\n"


def run(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The verb in a process of its own."""
    command = [sys.executable, str(ROOT / "pipelines" / "bench.py"), *SMALL, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path)


def test_rows_are_measured_compared_and_written_into_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(OTHERS)
    done = run(tmp_path, "rows='farthest-points,ball-query,set-abstraction,gpu-champion'", "page=page.md")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["stage"], result["seed"], result["rounds"], result["failures"]) == ("bench", 0, 2, {})
    assert {"commit", "hardware", "versions", "load"} <= set(result)
    order, balls, layer, champion = result["rows"]
    assert (order["equal"], balls["equal"]) == ("identical, prefixes too", "identical")
    assert set(balls["references"]) == {"torch cdist", "numpy"}
    assert len(balls["rounds_ms"]) == len(balls["references"]["numpy"]["rounds_ms"]) == 2
    assert balls["references"]["torch cdist"]["factor"] > 1
    assert layer["goals"][0]["against"] == "Conv2d and BatchNorm"
    assert champion["reason"].startswith("run make train")
    text = page.read_text()
    assert text.startswith(OTHERS)
    section = text[len(OTHERS) :]
    assert section.startswith("\n<!-- speed: written by make bench -->\n| row | what |")
    assert section.endswith(".\n<!-- end of speed -->\n")
    assert [line.split(" | ")[0] for line in section.splitlines()[4:25]] == [f"| {row.name}" for row in bench_rows.ROWS]
    assert "| normals | | | not run |" in section
    kept = json.loads((tmp_path / "page" / "speed.json").read_text())["rows"]
    assert list(kept) == ["farthest-points", "ball-query", "set-abstraction", "gpu-champion"]
    assert "ball-query" in done.stderr
    assert "not measured" in done.stderr


def test_a_wrong_row_is_refused_with_one_sentence(tmp_path: Path) -> None:
    done = run(tmp_path, "rows=ball-qery")
    assert done.returncode == 2
    assert done.stderr.startswith("bench: rows must be among farthest-points, ball-query, ")
    assert done.stderr.endswith("; got 'ball-qery', did you mean 'ball-query'?\n")
    assert done.stdout == ""


def test_every_row_has_a_contest_and_a_name_of_its_own() -> None:
    assert len({row.name for row in bench_rows.ROWS}) == len(bench_rows.ROWS)
    for row in bench_rows.ROWS:
        module, _, function = row.prepare.partition(":")
        text = (
            ROOT / "src/attentionvote/workflows/speed" / f"{module}.py"
        ).read_text()  # not imported: onnxruntime and the exporter are slow
        assert f"\ndef {function}(material: Material" in text, row.name
    assert bench_rows.select_rows("normals, ball-query") == [bench_rows.ROWS[1], bench_rows.ROWS[2]]


def test_unequal_results_are_an_error_and_no_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = sampling_reference.ball_query

    def wrong(*arguments: Any) -> Any:
        neighbors, found = right(*arguments)
        neighbors[0, 0] += 1
        return neighbors, found

    monkeypatch.setattr(sampling_reference, "ball_query", wrong)
    page = tmp_path / "page.md"
    cfg = compose(SpeedSettings, [*SMALL, "rows='ball-query,gpu-champion'", f"page={page}"])
    with pytest.raises(
        Refused, match=r"1 rows failed \(first: ball-query: results must be identical to those of numpy"
    ):
        bench.run(cfg)
    kept = json.loads((tmp_path / "page" / "speed.json").read_text())["rows"]
    assert list(kept) == ["gpu-champion"]
