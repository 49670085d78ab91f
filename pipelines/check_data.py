"""Look at a dataset in the Fraunhofer IPA, Sileane or BOP layout: what it is, what it counts, what is wrong with it.

    make check-data DIR=data/ipa [ARGS="scenes=200"]

DIR may be a dataset's own folder or hold several. Exit code 1 when something is wrong, 2 when it is none of the
formats (docs/datasets.md).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.entry import command
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.workflows.settings import CheckDataSettings

if TYPE_CHECKING:
    from attentionvote.datasets.check import Report

log = logging.getLogger("attentionvote.check_data")


def run(cfg: CheckDataSettings) -> dict[str, Any]:
    """Recognise, check, show; the same as data.

    Raises:
        Refused: when something is wrong.
    """
    from attentionvote.datasets import UnknownLayout, open_datasets
    from attentionvote.datasets.check import check_dataset

    if not cfg.directory:
        raise ConfigurationError("directory must be given, e.g. directory=data/ipa")
    try:
        datasets = open_datasets(Path(cfg.directory))
    except UnknownLayout as error:
        raise ConfigurationError(str(error)) from error
    except (ValueError, OSError) as error:
        raise Refused(
            str(error), {"stage": "check_data", "directory": cfg.directory, "errors": [str(error)]}
        ) from error
    reports = []
    for dataset in datasets:
        log.info("looking at %s, %s (%d scenes)", dataset.title, dataset.split, len(dataset.names))
        reports.append(check_dataset(dataset, cfg.scenes))
    show(reports)
    errors = [sentence for report in reports for sentence in report.errors]
    result = {
        "stage": "check_data",
        "directory": cfg.directory,
        "datasets": [as_data(report) for report in reports],
        "errors": errors,
    }
    if errors:
        more = f" (and {len(errors) - 1} more, see above)" if len(errors) > 1 else ""
        raise Refused(f"{errors[0]}{more}", result)
    return result


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
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in ("format", "dataset", "split"):
        table.add_column(name, overflow="fold")
    for name in ("scenes", ">= 5 drops", "expected", "opened", "parts", "off", "wrong"):
        table.add_column(name, justify="right")
    for report in reports:
        dataset, placement = report.dataset, report.placement
        counts = (len(dataset.names), report.scored, report.expected, report.opened, report.instances)
        cells = ["-" if value is None else f"{value}" for value in (*counts, placement.misplaced, len(report.errors))]
        table.add_row(dataset.format, dataset.title, dataset.split, *cells)
    Console(stderr=True).print(table)
    for report in reports:
        for finding in report.findings:
            (log.error if finding.severity == "error" else log.warning)("%s", finding.sentence)


if __name__ == "__main__":
    command(CheckDataSettings, run)
