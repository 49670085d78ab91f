"""Lightning's Trainer by the settings: devices, switches, callbacks of ours and of the user's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.profilers import AdvancedProfiler, Profiler, PyTorchProfiler, SimpleProfiler
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from attentionvote.section import Target
from attentionvote.training.averaging import MovingAverage
from attentionvote.training.checkpoint_writer import AtomicCheckpoints
from attentionvote.training.schedule import JUDGED_BY
from attentionvote.training.synced_norm import RowNormSync
from attentionvote.training.termination import PlainTermination
from attentionvote.workflows.sweep.trial_report import trial_callbacks
from attentionvote.workflows.train.job import TrainingJob
from attentionvote.workflows.train.processes import TrainingProcess
from attentionvote.workflows.train.settings import TrainSettings

_PROFILERS: dict[str, type[Profiler]] = {
    "simple": SimpleProfiler,
    "advanced": AdvancedProfiler,
    "pytorch": PyTorchProfiler,
}


def lightning_trainer(
    cfg: TrainSettings,
    job: TrainingJob,
    process: TrainingProcess,
    watching: list[Callback],
    checkpoint_files: AtomicCheckpoints,
) -> L.Trainer:
    """The trainer of a training.

    Args:
        cfg: its settings.
        job: its folder and precision.
        process: this one among those that share it.
        watching: callbacks of the run's.
        checkpoint_files: how checkpoints are written.

    Raises:
        ValueError: with one sentence, when the settings are impossible on this machine.
    """
    t, folder = cfg.trainer, job.directory
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(checkpoints, "best", monitor=JUDGED_BY, mode="max", enable_version_counter=False)
    last = ModelCheckpoint(checkpoints, "last", enable_version_counter=False, save_on_train_epoch_end=True)
    callbacks: list[Callback] = [best, last, *watching, *trial_callbacks()]
    callbacks += [made(f"callbacks.{name}", callback) for name, callback in cfg.callbacks.items()]
    if t.average_decay:
        callbacks.append(MovingAverage(t.average_decay))
    if process.processes > 1:
        callbacks.append(PlainTermination())
    try:
        return L.Trainer(
            accelerator=t.accelerator,
            **process.trainer_arguments(),
            precision=job.precision,  # type: ignore[arg-type]
            max_epochs=t.max_epochs,
            max_steps=-1 if t.max_steps is None else t.max_steps,
            accumulate_grad_batches=t.accumulate_grad_batches,
            limit_train_batches=t.limit_train_batches,
            limit_val_batches=t.limit_val_batches,
            fast_dev_run=t.fast_dev_run,
            deterministic=t.deterministic or None,
            profiler=_profiler(t.profiler, folder),
            gradient_clip_val=t.gradient_clip,
            check_val_every_n_epoch=t.validate_every,
            log_every_n_steps=t.log_every_steps,
            num_sanity_val_steps=0,
            logger=False,
            callbacks=callbacks,
            plugins=[checkpoint_files, *([RowNormSync()] if process.processes > 1 else [])],
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=folder,
        )
    except (MisconfigurationException, RuntimeError) as error:  # no such device, say
        raise ValueError(f"trainer settings cannot be met: {error}") from error


def made(key: str, target: Target) -> Any:
    """What a section of the user's names.

    Raises:
        ValueError: with the setting's name, whatever the target raises.
    """
    try:
        return target()
    except Exception as error:  # a user's own code, or a package that is not installed
        raise ValueError(f"{key} cannot be made: {type(error).__name__}: {error}") from error


def _profiler(name: str | None, folder: Path) -> Profiler | None:
    """A profiler of Lightning that writes its report into a folder."""
    return None if name is None else _PROFILERS[name](dirpath=folder, filename="profile")
