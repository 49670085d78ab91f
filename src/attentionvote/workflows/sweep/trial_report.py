"""In the process of a trial: what its training reports to the study, and the end of a trial that is not worth it."""

from __future__ import annotations

import json
import os
import warnings
from typing import TYPE_CHECKING

import lightning as L
from lightning.pytorch.callbacks import Callback

from attentionvote.workflows.sweep.trial_place import PRUNED_AT, PRUNED_CODE, VARIABLE

if TYPE_CHECKING:
    from optuna.trial import Trial


def trial_callbacks() -> list[Callback]:
    """What a training needs as a trial of a sweep; nothing elsewhere."""
    said = os.environ.get(VARIABLE)
    if said is None:
        return []
    from optuna.trial import Trial

    from attentionvote.workflows.sweep.study import make_pruner, open_study

    about = json.loads(said)
    study = open_study(about["url"], about["study"], about["heartbeat_s"], make_pruner(**about["pruner"]))
    return [TrialReport(Trial(study, study.trials[about["number"]]._trial_id))]


class TrialReport(Callback):
    """Reports val/ap by epoch and ends the training, with exit code 3, when the study's pruner says so.

    The end comes with the start of the next epoch, when the checkpoints of this one are written: the same settings
    may be trained to the end later. The last validation prunes nothing: the trial is complete.
    """

    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        self.pruned = False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Report the score."""
        del pl_module
        if trainer.sanity_checking or "val/ap" not in trainer.callback_metrics:
            return
        epoch = trainer.current_epoch + 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an epoch repeated after a kill -9 gives the value that is there
            self.trial.report(float(trainer.callback_metrics["val/ap"]), epoch)
        self.pruned = epoch < (trainer.max_epochs or 0) and self.trial.should_prune()
        if self.pruned:
            self.trial.set_user_attr(PRUNED_AT, epoch)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """End the process of a pruned trial."""
        del trainer, pl_module
        if self.pruned:
            raise SystemExit(PRUNED_CODE)
