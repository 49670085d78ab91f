"""What a person sees during training: one bar over all steps with the time left, the losses and the last AP."""

from __future__ import annotations

import sys
import time
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class TrainingProgress(Callback):
    """A bar on stderr; where stderr is no terminal, a line after every validation instead."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.bar: Progress | None = None
        self.task: TaskID | None = None
        self.scores = ""
        self.start, self.first_step = time.monotonic(), 0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar."""
        del pl_module
        self.start, self.first_step = time.monotonic(), trainer.global_step
        if not self.console.is_terminal:
            return
        columns = (TextColumn("training"), BarColumn(), TextColumn("{task.completed}/{task.total} steps"))
        times = (TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[state]}"))
        self.bar = Progress(*columns, *times, console=self.console)
        self.task = self.bar.add_task("", total=self._total(trainer), completed=trainer.global_step, state="")
        self.bar.start()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Move the bar."""
        del pl_module
        if self.bar is not None and self.task is not None and trainer.global_step % 5 == 0:
            losses = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("train/loss/")}
            short = " ".join(f"{k.removeprefix('train/loss/')} {v:.2f}" for k, v in losses.items())
            self.bar.update(self.task, completed=trainer.global_step, state=f"{short}  {self.scores}")

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Remember the scores, and print them where there is no bar."""
        del pl_module
        metrics = trainer.callback_metrics
        if "val/ap_10" not in metrics or trainer.sanity_checking:
            return
        self.scores = "AP " + "/".join(f"{float(metrics[f'val/ap_{k}']):.3f}" for k in (10, 5, 2))
        if self.bar is None:
            done, total = trainer.global_step, self._total(trainer)
            rate = (time.monotonic() - self.start) / max(1, done - self.first_step)
            left = f"{rate * (total - done) / 60:.0f} min left"
            print(f"step {done} of {total}: {self.scores} at 10/5/2 % D, {left}", file=sys.stderr, flush=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Close the bar."""
        del trainer, pl_module
        self._close()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Close the bar, so that the terminal is left as it was."""
        del trainer, pl_module, exception
        self._close()

    def _close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    @staticmethod
    def _total(trainer: L.Trainer) -> int:
        return int(trainer.estimated_stepping_batches)
