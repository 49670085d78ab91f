"""Look at a dataset in the Fraunhofer IPA, Sileane or BOP layout: what it is, what it counts, what is wrong with it.

    make check-data DIR=data/ipa [ARGS="scenes=200"]

DIR may be a dataset's own folder or hold several. Exit code 1 when something is wrong, 2 when it is none of the
formats (docs/datasets.md).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from attentionvote.command.entry import command
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.workflows.check_data import as_data, show
from attentionvote.workflows.settings import CheckDataSettings

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


if __name__ == "__main__":
    command(CheckDataSettings, run)
