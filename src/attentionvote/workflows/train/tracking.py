"""The MLflow run of a training: what it is told when it is opened, new or again."""

from __future__ import annotations

import json
import logging
from typing import Any

from attentionvote.files import write_json
from attentionvote.tracking.run import Run
from attentionvote.tracking.run_opening import start_run
from attentionvote.training.module import PoseTraining
from attentionvote.workflows.train.job import RUN, TrainingJob
from attentionvote.workflows.train.settings import TrainSettings

log = logging.getLogger("attentionvote.train")
DATASET = "dataset.json"


def open_tracking(cfg: TrainSettings, job: TrainingJob, module: PoseTraining, processes: int) -> Run:
    """The run of a training, the one it began with where the store still has it.

    Args:
        cfg: of the training.
        job: whose folder keeps the run's id.
        module: with the digests of the scenes in its metadata.
        processes: that share the training.
    """
    part, counts = job.part, job.scene_counts
    choices: dict[str, object] = {
        "object": part.name,
        "diameter": part.diameter,
        "seed": cfg.seed,
        "points": cfg.data.points,
        "parameters": sum(p.numel() for p in module.model.parameters()),
        "train_scenes": counts["train"],
        "epochs": cfg.trainer.max_epochs,
        "batch_size": cfg.trainer.batch_size,
        "learning_rate": cfg.trainer.learning_rate,
    }
    if job.dataset is not None:
        choices["dataset"] = str(job.dataset)
    settings: dict[str, Any] = {
        "store": cfg.tracking.store,
        "experiment": part.name,
        "name": f"{part.name}-{job.directory.name}",
        "params": choices,
        "tags": {"processes": processes},
        "config_yaml": cfg.yaml(),
        "datasets": {split: module.metadata["data"][split] for split in counts},
        "system_interval_s": cfg.tracking.system_interval,
        "parent": cfg.tracking.parent,
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
