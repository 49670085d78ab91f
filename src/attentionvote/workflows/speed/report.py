"""What ``make bench`` measured: a table for the terminal, a section of docs/benchmarks.md, and the record beside it."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from attentionvote.command.tables import show_table
from attentionvote.files import write_json
from attentionvote.workflows.page_sections import record_of, stored_beside

SECTION = "speed"
COMMAND = "make bench"
NOT_JUDGED = "not judged"
_MET = {True: "met", False: "**not met**", None: NOT_JUDGED}
Rows = Mapping[str, Mapping[str, Any]]  # by name, see ``bench_row.measure``


def run_facts(seed: int, rounds: int) -> dict[str, Any]:
    """Where and of what this run's figures are; the same texts for every row of it."""
    from attentionvote.tracking.provenance import git_state, hardware, package_versions

    machine = hardware()
    return {
        "commit": git_state(Path(__file__).parent).label,
        "hardware": {name: machine[name] for name in ("cpu", "cores", "memory_gib", "gpu")},
        "versions": package_versions() | {"onnxruntime": version("onnxruntime")},
        "seed": seed,
        "rounds": rounds,
        "load": round(os.getloadavg()[0], 1),
        "date": time.strftime("%Y-%m-%d"),
    }


def stored_rows(page: Path) -> dict[str, dict[str, Any]]:
    """The rows of earlier calls, which the page goes on to show.

    Raises:
        ValueError: when their file is damaged.
    """
    return dict(stored_beside(page, SECTION, "rows", COMMAND) or {})


def keep(page: Path, rows: Rows) -> None:
    """Write the record whole."""
    write_json(record_of(page, SECTION), {"rows": dict(rows)})


def markdown(names: Sequence[str], rows: Rows) -> str:
    """The section's text.

    Args:
        names: of all rows, in the table's order.
        rows: what is known of them, each with the facts of its run.
    """
    runs: list[Any] = []
    for name in names:
        if name in rows and rows[name]["run"] not in runs:
            runs.append(rows[name]["run"])
    lines = [
        "| row | what | of | ours | beside it | to reach | | equal | run |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        if name not in rows:
            lines.append(f"| {name} | | | not run | | | | | |")
            continue
        row = rows[name]
        cells = [name, *_cells(row), chr(ord("A") + runs.index(row["run"]))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *(_run(chr(ord("A") + i), run) for i, run in enumerate(runs))]) + "\n"


def show(names: Sequence[str], rows: Rows) -> None:
    """The same on stderr."""
    cells = [(name, *(cell.replace("**", "") for cell in _cells(rows[name])[1:])) for name in names if name in rows]
    columns = ("row", "of", "ours", "beside it", "to reach", "", "equal")
    show_table(columns, cells, width=None if os.isatty(2) else 200)


def _cells(row: Mapping[str, Any]) -> list[str]:
    """What, of, ours, beside it, to reach, verdict, equal."""
    if "reason" in row:
        return [row["title"], "", f"not measured: {row['reason']}", "", _goals(row), "", ""]
    beside = [
        f"{name} {_ms(reference['ms'])} ({reference['factor']:.3g} x)" for name, reference in row["references"].items()
    ]
    beside += [f"{name} not installed" for name in row["absent"]]
    ours = f"{_ms(row['ms'])} a {row['item']} ({row['clock']})"
    return [row["title"], row["size"], ours, "; ".join(beside), _goals(row), _MET[row["met"]], row["equal"]]


def _goals(row: Mapping[str, Any]) -> str:
    return "; ".join(goal["text"] for goal in row["goals"])


def _ms(value: float) -> str:
    if value >= 10_000:
        return f"{value / 1000:.3g} s"
    return f"{value:.0f} ms" if value >= 100 else f"{value:.3g} ms"


def _run(letter: str, run: Mapping[str, Any]) -> str:
    machine, versions = run["hardware"], run["versions"]
    stated = ", ".join(
        f"{name} {versions[name]}" for name in ("torch", "onnxruntime", "numpy", "scipy") if name in versions
    )
    label, plus, changes = run["commit"].partition("+")
    commit = f"{label[:12]}{plus}{changes}"
    where = f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gib']} GiB, GPU {machine['gpu']}"
    how = f"seed {run['seed']}, medians of {run['rounds']} rounds, load {run['load']} at the start"
    return f"Run {letter}: {run['date']}, commit `{commit}`, {where}; {stated}; {how}."
