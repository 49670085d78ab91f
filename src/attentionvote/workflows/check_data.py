"""The report on a dataset, as data and as a table."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from attentionvote.command.tables import show_table

if TYPE_CHECKING:
    from attentionvote.datasets.check import Report

log = logging.getLogger("attentionvote.check_data")


def as_data(report: Report) -> dict[str, Any]:
    """A report as JSON has it."""
    dataset = report.dataset
    return {
        "format": dataset.format,
        "title": dataset.title,
        "split": dataset.split,
        "parts": list(dataset.parts),
        "directory": str(dataset.directory),
        "scenes": len(dataset.names),
        "with_five_drops": report.scored,
        "expected": report.expected,
        "opened": report.opened,
        "instances": report.instances,
        "poses_looked_at": report.placement.looked_at,
        "poses_off_their_points": report.placement.misplaced,
        "errors": list(report.errors),
        "warnings": [finding.sentence for finding in report.findings if finding.severity == "warning"],
    }


def show(reports: list[Report]) -> None:
    """A table on stderr, and every finding under it."""
    numbers = ("scenes", ">= 5 drops", "expected", "opened", "parts", "off", "wrong")
    rows = []
    for report in reports:
        dataset, placement = report.dataset, report.placement
        counts = (len(dataset.names), report.scored, report.expected, report.opened, report.instances)
        cells = ["-" if value is None else f"{value}" for value in (*counts, placement.misplaced, len(report.errors))]
        rows.append((dataset.format, dataset.title, dataset.split, *cells))
    show_table(("format", "dataset", "split", *numbers), rows, numbers=numbers)
    for report in reports:
        for finding in report.findings:
            (log.error if finding.severity == "error" else log.warning)("%s", finding.sentence)
