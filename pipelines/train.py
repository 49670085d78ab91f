"""Train a part's network: generate what is missing, train, validate, test, track.

    make train OBJECT=connecting_rod [PROCESSES=8] [ARGS="trainer.max_epochs=20 seed=1"]
    make train OBJECT=gear_shaft ARGS="data.dataset=/data/ipa/training/GearShaft object.mesh=/data/ipa/GearShaft.stl"

The default preset follows the hardware: compact on a CPU, gpu where there is a GPU; ARGS="experiment=paper" is the
paper's. With data.dataset=DIR the scenes are a public dataset's (docs/datasets.md): its own val and test, or drop
cycles held out (data.held_out). Interrupted, also by kill -9, the same command goes on where it was, in the same MLflow
run; a training that is complete is not repeated without force=true. PROCESSES share every batch, one a GPU
(docs/several-processes.md).
"""

from __future__ import annotations

import logging
import os
from contextlib import nullcontext
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.workflows.train.preset import preset_of_hardware
from attentionvote.workflows.train.processes import TrainingProcess, failing_at_once, first_speaks
from attentionvote.workflows.train.settings import TrainSettings

log = logging.getLogger("attentionvote.train")


def run(cfg: TrainSettings) -> dict[str, Any] | None:
    """Make or read scenes, train, test; test figures and where the model is, None in all processes but the first."""
    process = TrainingProcess.of(os.environ)
    with first_speaks(process):
        return _run(cfg, process)


def _run(cfg: TrainSettings, process: TrainingProcess) -> dict[str, Any] | None:
    from attentionvote.workflows.train.job import find_training

    with configuring(f"object {cfg.object.name}"):
        job = find_training(cfg)
    with configuring():
        process.check(cfg.trainer.batch_size, job.scene_counts)
    # The lock comes before the meeting: a training that another process is at ends at once.
    with job.locked() if process.rank == 0 else nullcontext(), process.joined(cfg.trainer.accelerator) as first_does:
        result = job.result if process.rank == 0 else None
        complete = result is not None and cfg.resume != "never" and not cfg.force
        if first_does("complete", lambda: complete):
            if result is not None:
                commit = str(result.get("commit", "unknown"))[:12]
                log.info(
                    "this training is complete, made at commit %s (force=true repeats it): %s", commit, job.directory
                )
            return result
        from attentionvote.workflows.train.run import TrainingRun

        with configuring():
            training = TrainingRun(cfg, job, process, first_does)
        if process.rank == 0 and (cfg.resume == "never" or (cfg.force and result is not None)):
            job.forget()
        return training.run()


def check(cfg: TrainSettings) -> None:
    """What a grid asks of every job before the first starts: the parts of its configuration fit together."""
    from attentionvote.workflows.train.job import find_training

    find_training(cfg)


if __name__ == "__main__":
    with failing_at_once(os.environ):
        command(TrainSettings, run, defaults=preset_of_hardware, check=check)
