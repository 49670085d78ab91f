"""The rows of ``make bench``, measured in one run."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.configuration import compose
from attentionvote.command.entry import configuring
from attentionvote.command.errors import Refused, sentence
from attentionvote.workflows.speed.contest import NotMeasured, Row, Unequal, measure
from attentionvote.workflows.speed.rows import ROWS, select_rows
from attentionvote.workflows.speed.settings import SpeedSettings
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.workflows.speed.material import Material


log = logging.getLogger("attentionvote.bench")


def run(cfg: SpeedSettings) -> dict[str, Any]:
    """Measure the chosen rows, show them, and write them down."""
    from attentionvote.workflows.page_sections import put
    from attentionvote.workflows.speed.report import COMMAND, SECTION, keep, markdown, run_facts, show, stored_rows

    with configuring():
        rows, material = select_rows(cfg.rows), _material(cfg)
        earlier = stored_rows(Path(cfg.page)) if cfg.page else {}
    facts = run_facts(cfg.seed, cfg.rounds)
    with material:
        rows_done, failures = measured(rows, material, cfg.rounds)
    done = {name: {**row, "run": facts} for name, row in rows_done.items()}
    names = [row.name for row in ROWS]
    show(names, done)
    if cfg.page:
        page = Path(cfg.page)
        shown_rows = {name: row for name, row in earlier.items() if name not in failures} | done
        keep(page, shown_rows)
        put(page, SECTION, markdown(names, shown_rows), COMMAND)
        log.info("written into %s", page)
    result = {"stage": "bench", **facts, "rows": list(rows_done.values()), "failures": failures, "page": cfg.page}
    if failures:
        name, reason = next(iter(failures.items()))
        raise Refused(f"{len(failures)} rows failed (first: {name}: {reason})", result)
    return result


def measured(rows: Sequence[Row], material: Material, rounds: int) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """What was measured by name, and why the others failed."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    rows_done: dict[str, dict[str, Any]] = {}
    failures: dict[str, str] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=len(rows) * rounds)
        for index, row in enumerate(rows):
            bar.update(task, description=f"{row.name}: preparing", completed=index * rounds)
            try:
                rows_done[row.name] = _measured(row, material, rounds, lambda: bar.advance(task))
            except NotMeasured as error:
                goals = [{"text": goal.text, "met": None} for goal in row.goals]
                rows_done[row.name] = {
                    "row": row.name,
                    "title": row.title,
                    "reason": str(error),
                    "goals": goals,
                    "met": None,
                }
            except Unequal as error:
                failures[row.name] = sentence(error)
                log.error("%s: %s", row.name, sentence(error))
    return rows_done, failures


def _measured(row: Row, material: Material, rounds: int, progress: Any) -> dict[str, Any]:
    module, _, function = row.prepare.partition(":")
    with _threads(row.cores):
        contest = getattr(import_module(f"attentionvote.workflows.speed.{module}"), function)(material, *row.arguments)
        return measure(row, contest, rounds, progress)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _material(cfg: SpeedSettings) -> Material:
    """What the rows work on; the configurations of the two trainings are checked with it."""

    from attentionvote.workflows.speed.material import Material

    words = [f"object={cfg.object.name}", f"seed={cfg.seed}"]
    trainings = {size: compose(TrainSettings, [*words, *getattr(cfg, size)]) for size in ("compact", "full")}
    return Material(cfg.object(), trainings, dict(cfg.batch), cfg.seed)
