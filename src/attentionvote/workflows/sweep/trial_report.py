"""In the process of a trial: what its training reports to the study, and the end of a trial that is not worth it.

A trial is an ordinary training. The sweep that starts it says so in one variable of the environment, because
whose trial it is does not belong to the settings of the training.
"""

from __future__ import annotations

import json
import os
import warnings
from typing import TYPE_CHECKING

import lightning as L
from lightning.pytorch.callbacks import Callback

from attentionvote.workflows.sweep.settings import PRUNED_AT, PRUNED_CODE, TRIAL

if TYPE_CHECKING:
    from attentionvote.workflows.sweep.study import StoredStudy


def trial_callbacks() -> list[Callback]:
    """What a training needs as a trial of a sweep; nothing elsewhere."""
    trial = os.environ.get(TRIAL)
    if trial is None:
        return []
    from attentionvote.workflows.sweep.study import make_pruner, open_study

    about = json.loads(trial)
    stored = open_study(about["url"], about["study"], make_pruner(**about["pruner"]))
    return [TrialReport(stored, about["number"], about["owner"])]


class TrialReport(Callback):
    """Reports val/ap by epoch and ends the training, with exit code 3, when the study's pruner says so.

    The end comes with the start of the next epoch, when the checkpoints of this one are written: the same settings
    may be trained to the end later. The last validation prunes nothing: the trial is complete.
    """

    def __init__(self, stored: StoredStudy, number: int, owner: str) -> None:
        self.stored, self.number, self.owner = stored, number, owner
        self.trial = stored.trial(number)
        self.pruned = False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Report the score.

        Raises:
            ValueError: when another sweep has taken the study over: the trial is its, and trained by its training.
        """
        del pl_module
        if trainer.sanity_checking or "val/ap" not in trainer.callback_metrics:
            return
        if (owner := self.stored.owner()) not in (None, self.owner):
            raise ValueError(f"the training ends, because the sweep at {owner} took its trial {self.number} over")
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
