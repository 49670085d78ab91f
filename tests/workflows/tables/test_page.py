"""The page: the paper's numbers, ours, what was not run; a section is replaced, the rest of the page stays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from attentionvote.workflows.page_sections import put
from attentionvote.workflows.tables.page import draw, markdown
from attentionvote.workflows.tables.table import BenchmarkTable, Curve, PaperRow, Row

TABLE = BenchmarkTable(
    "table_0",
    "Table 0: a title",
    ("ap_10",),
    ("brick", "gear"),
    (Row("ours"), Row("PPF", "ppf")),
    (PaperRow("theirs", "ap_10", (0.5, None)),),
)


def cell(ap: float, **changes: Any) -> dict[str, Any]:
    """A measured cell."""
    return {
        "figures": {"ap_10": ap, "latency_p50_ms": 56.4}, "intervals": {"ap_10": [ap - 0.01, ap + 0.01]},
        "thresholds": [0.0, 0.05, 0.1], "ap_by_threshold": [0.0, 0.5, ap], "scenes": 65, "evaluation_set": "ab" * 32,
        "frozen": True, "sensor": "gaussian", "machine": "CPU, 2 cores", "seed": 0, "commit": "c" * 40,
        "budget": {"steps": 864, "train_seconds": 540.0, "train_scenes": 1170}, **changes,
    }  # fmt: skip


def test_the_papers_ours_and_what_was_not_run_stand_side_by_side() -> None:
    text = markdown(
        TABLE,
        {
            ("ours", "brick"): cell(0.9),
            ("PPF", "brick"): cell(0.3, budget=None, frozen=False, commit="d" * 40 + "+dirty"),
        },
        None,
    )
    assert text == (
        "### Table 0: a title\n\n"
        "| | brick | gear | mean |\n"
        "|---|---|---|---|\n"
        "| paper: theirs | 0.500 |  |  |\n"
        "| **ours** | 0.900 | not run |  |\n"
        "| **PPF** | 0.300 | not run |  |\n"
        "\n"
        "| row | object | scenes | 95 % of AP 10 % | a scene (p50) | training | seed | commit | set | hardware |\n"
        "|---|---|---|---|---|---|---|---|---|---|\n"
        "| ours | brick | 65 | 0.890 to 0.910 | 56 ms | 864 steps, 1170 scenes, 9 min | 0 | `cccccccccccc` "
        "| gaussian `abababababab` | CPU, 2 cores |\n"
        "| PPF | brick | 65 | 0.290 to 0.310 | 56 ms | none | 0 | `dddddddddddd+dirty` "
        "| gaussian `abababababab` (not the frozen one) | CPU, 2 cores |\n"
    )


def test_a_set_of_one_cycle_has_no_interval() -> None:
    assert "| ours | brick | 13 | none | 56 ms |" in markdown(
        TABLE, {("ours", "brick"): cell(0.9, intervals={}, scenes=13)}, None
    )


def test_the_mean_is_of_all_objects_or_not_there() -> None:
    text = markdown(TABLE, {("ours", "brick"): cell(0.9), ("ours", "gear"): cell(0.8)}, None)
    assert "| **ours** | 0.900 | 0.800 | 0.850 |" in text


def test_nothing_run_is_said() -> None:
    assert markdown(TABLE, {}, None).endswith("| PPF | not run | not run |  |\n\nNothing of it was run here.\n")


def test_a_section_is_replaced_and_the_rest_stays(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "page.md"
    put(page, "table_0", "first\n")
    page.write_text(page.read_text() + "\nwritten by hand\n")
    put(page, "table_1", "another\n")
    put(page, "table_0", "second\n")
    page.write_text(page.read_text().replace("<!-- end of table_0 -->", "<!-- end of table_0 --> "))
    put(page, "table_0", "second\n")
    assert page.read_text() == (
        "# Benchmarks\n\n"
        "<!-- table_0: written by make benchmark -->\nsecond\n<!-- end of table_0 -->\n\n"
        "written by hand\n\n"
        "<!-- table_1: written by make benchmark -->\nanother\n<!-- end of table_1 -->\n"
    )


@pytest.mark.parametrize(
    ("curve", "rows"),
    [
        (Curve("ap_by_threshold", "x", "y"), ("ours", "PPF")),
        (Curve("ap_10", "x", "y"), ("0.3", "0.4")),
    ],
)
def test_curves_are_drawn_of_what_was_measured(tmp_path: Path, curve: Curve, rows: Any) -> None:
    from PIL import Image

    table = BenchmarkTable("figure_0", "Fig. 0", ("ap_10",), ("brick",), tuple(map(Row, rows)), (), curve)
    picture = tmp_path / "images" / "figure.png"
    assert not draw(table, curve, {}, picture)
    assert not picture.exists()
    assert draw(table, curve, {(row, "brick"): cell(0.9) for row in rows}, picture)
    with Image.open(picture) as image:
        assert image.size == (660, 440)
    assert f"![Fig. 0]({picture.name})" in markdown(table, {}, picture.name)
