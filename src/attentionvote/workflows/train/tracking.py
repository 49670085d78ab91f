"""The MLflow run of a training: what it is told when it is opened, new or again."""

from __future__ import annotations

import json
import logging
from typing import Any

from attentionvote.command.sections import Tracking
from attentionvote.files import write_json
from attentionvote.tracking.run import Run
from attentionvote.tracking.run_opening import start_run
from attentionvote.training.module import PoseTraining
from attentionvote.workflows.train.job import RUN, TrainingJob

log = logging.getLogger("attentionvote.train")
DATASET = "dataset.json"


def open_tracking(
    job: TrainingJob,
    module: PoseTraining,
    choices: dict[str, object],
    processes: int,
    tracking: Tracking,
    config_yaml: str,
) -> Run:
    """The run of a training, the one it began with where the store still has it.

    Args:
        job: whose folder keeps the run's id.
        module: with the digests of the scenes in its metadata.
        choices: parameters of the run.
        processes: that share the training.
        tracking: where and how it is tracked.
        config_yaml: the settings whole.
    """
    part = job.part
    settings: dict[str, Any] = {
        "store": tracking.store,
        "experiment": part.name,
        "name": f"{part.name}-{job.directory.name}",
        "params": choices,
        "tags": {"processes": processes},
        "config_yaml": config_yaml,
        "datasets": {split: module.metadata["data"][split] for split in job.scene_counts},
        "system_interval_s": tracking.system_interval,
        "parent": tracking.parent,
    }
    run_id = job.run_id
    try:
        run = start_run(run_id=run_id, **settings)
    except ValueError:
        if run_id is None:
            raise
        log.warning("the MLflow run %s is gone from the store: the training goes on in a new one", run_id)
        run = start_run(run_id=None, **settings)
    write_json(job.directory / RUN, {"run_id": run.id})
    if job.dataset is not None:
        run.log_text(DATASET, json.dumps(module.metadata["dataset"], indent=2))
    return run
