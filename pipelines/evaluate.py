"""Evaluate an exported model: the bundle, through the estimator that cells run, on a frozen set it has never seen.

    make evaluate OBJECT=connecting_rod [ARGS="bundle=3fa9c1 evaluation.cycles=20"]

What the model bears at other distances than it was trained for, a figure each:

    make evaluate OBJECT=connecting_rod ARGS="-m simulation.camera.distance=0.4,0.6,0.8,1.0"

Figures with 95 % intervals over drop cycles, recall by visibility, and the time of an estimate on this machine;
written into the MLflow run of the training and to outputs/evaluate. What is done is not repeated without force=true.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.files import read_json, write_json
from attentionvote.workflows.evaluate.settings import EvaluateSettings

log = logging.getLogger("attentionvote.evaluate")


def run(cfg: EvaluateSettings) -> dict[str, Any]:
    """Measure, record, show; the figures."""
    from attentionvote.files import locked_folder
    from attentionvote.workflows.evaluate.frozen_set import is_recorded
    from attentionvote.workflows.evaluate.job import EvaluationJob
    from attentionvote.workflows.evaluate.report import described, record, show

    with configuring():
        job = EvaluationJob.find(cfg)
    folder = Path(cfg.outputs) / job.part.name
    with locked_folder(folder, cfg.outputs, "part's evaluation"):
        with configuring():
            frozen = job.evaluation_set()
        name = f"{job.bundle.digest[:12]}-{frozen.digest[:12]}{job.otherwise}"
        path = folder / f"{name}-{cfg.evaluation.threads}.json"
        result = read_json(path)
        if result is not None and "ap_by_threshold" in result and not cfg.force:
            log.info("this evaluation is done (force=true repeats it): %s", path)
            result |= {"frozen": is_recorded(cfg, job.part, frozen)}
        else:
            result = described(job, frozen, job.measure([job.bundle], frozen)[0])
            write_json(path, result)
        show(result)
        # Also when it is done: the store may have been away.
        record(
            cfg.tracking.store, job.bundle.card.run_id, result, f"{name}.json", job.is_standard and not job.is_elsewhere
        )
    return result


if __name__ == "__main__":
    command(EvaluateSettings, run)
