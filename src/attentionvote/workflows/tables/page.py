"""The benchmark's tables and curves in docs/benchmarks.md: the paper's numbers, ours beside them, what they cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attentionvote.files import whole
from attentionvote.workflows.tables.table import BenchmarkTable, Curve, mean, title_of

NOT_RUN = "not run"
Cells = Mapping[tuple[str, str], Mapping[str, Any]]  # (row, object) -> what was measured


def markdown(table: BenchmarkTable, cells: Cells, picture: str | None) -> str:
    """The section of a table.

    Args:
        table: of the paper.
        cells: what was measured, see ``benchmark_cells``.
        picture: path of its curves from the page; None without.
    """
    objects = table.objects
    lines = [f"### {table.title}", ""]
    if picture:
        lines += [f"![{table.title}]({picture})", ""]
    several = len(objects) > 1
    lines += [
        f"| | {' | '.join(name.replace('_', ' ') for name in objects)} |{' mean |' * several}",
        f"|---|{'---|' * (len(objects) + several)}",
    ]
    for figure in table.figures:
        of = f", {title_of(figure)}" if len(table.figures) > 1 else ""
        for paper_row in table.paper:
            if paper_row.figure == figure:
                texts = [_number(v) for v in paper_row.values]
                lines.append(_line(f"paper: {paper_row.method}{of}", texts, paper_row.values, several))
        for row in table.measured:
            row_cells = [cells.get((row.name, name)) for name in objects]
            values = [None if cell is None else cell["figures"].get(figure) for cell in row_cells]
            texts = [NOT_RUN if cell is None else _number(v) for cell, v in zip(row_cells, values, strict=True)]
            shown = f"**{row.name}**" if any(text != NOT_RUN for text in texts) else row.name
            lines.append(_line(shown + of, texts, values, several))
    return "\n".join([*lines, "", *_costs(table, cells)]) + "\n"


def _line(name: str, texts: Sequence[str], values: Sequence[float | None], several: bool) -> str:
    end = f" {_number(mean(values))} |" if several else ""
    return f"| {name} | {' | '.join(texts)} |{end}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _costs(table: BenchmarkTable, cells: Cells) -> list[str]:
    """What every measured cell cost and how it came about."""
    if not cells:
        return ["Nothing of it was run here."]
    lines = [
        "| row | object | scenes | 95 % of AP 10 % | a scene (p50) | training | seed | commit | set | hardware |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in table.measured:
        for name in table.objects:
            cell = cells.get((row.name, name))
            if cell is None:
                continue
            sure = cell["intervals"].get("ap_10")  # none of one drop cycle
            budget = cell["budget"]
            trained = "none" if budget is None else (
                f"{budget['steps']} steps, {budget['train_scenes']} scenes, {budget['train_seconds'] / 60:.0f} min"
            )  # fmt: skip
            same = {True: "", False: " (not the frozen one)", None: ""}[cell["frozen"]]
            commit, p50_ms = _commit(cell["commit"]), cell["figures"]["latency_p50_ms"]
            lines.append(
                f"| {row.name} | {name.replace('_', ' ')} | {cell['scenes']} "
                f"| {'none' if sure is None else f'{sure[0]:.3f} to {sure[1]:.3f}'} "
                f"| {p50_ms:.0f} ms | {trained} | {cell['seed']} | `{commit}` "
                f"| {cell['sensor']} `{cell['evaluation_set'][:12]}`{same} | {cell['machine']} |"
            )
    return lines


def _commit(label: str) -> str:
    name, plus, changes = label.partition("+")
    return name[:12] + plus + changes


def draw(table: BenchmarkTable, curve: Curve, cells: Cells, path: Path) -> bool:
    """The curves of a figure as a PNG; False when nothing of it was measured."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for name in table.objects:
        _draw_rows(axes, curve, table, cells, name)
    if not axes.lines:
        return False
    axes.set(xlabel=curve.x, ylabel=curve.y, ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    whole(path, lambda temporary: figure.savefig(temporary, dpi=110))
    return True


def _draw_rows(axes: Any, curve: Curve, table: BenchmarkTable, cells: Cells, name: str) -> None:
    """The curves of one object: one a row, or, where a row is a point, one of all rows."""
    measured = [(row, cells[row.name, name]) for row in table.measured if (row.name, name) in cells]
    label = name.replace("_", " ")
    if curve.figure in table.figures:
        points = [(float(row.name), cell["figures"][curve.figure]) for row, cell in measured]
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label=label)
        return
    for row, cell in measured:
        axes.plot(cell["thresholds"], cell[curve.figure], label=f"{label}, {row.name}")
