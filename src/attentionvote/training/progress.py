"""Progress of a training for people: one bar over all steps with the time left, the losses and the last AP."""

from __future__ import annotations

import sys
import time
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column

_REDRAW_S = 0.5
_LOSS = "train/loss/"


class TrainingProgress(Callback):
    """A bar on stderr; where stderr is no terminal, a line after every validation and at least every minute.

    Counts the seconds of training over all interruptions (``seconds``).
    """

    def __init__(self, console: Console | None = None, line_every_s: float = 60.0) -> None:
        self.console = console or Console(stderr=True)
        self.line_every_s = line_every_s
        self.bar: Progress | None = None
        self.task: TaskID | None = None
        self.scores = ""
        self.seconds = 0.0
        self._start = self._seen = time.monotonic()
        self._first_step = 0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar."""
        del pl_module
        self._start = self._seen = time.monotonic()
        self._first_step = trainer.global_step
        if not self.console.is_terminal:
            return
        columns = (TextColumn("training"), BarColumn(20), TextColumn("{task.completed}/{task.total}"))
        # On a narrow terminal the losses are cut, not the time left.
        state = TextColumn("{task.fields[state]}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis"))
        times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), state)
        self.bar = Progress(*columns, *times, console=self.console, speed_estimate_period=300, expand=True)
        self.task = self.bar.add_task("", total=_total(trainer), completed=trainer.global_step, state="")
        self.bar.start()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Move the bar, or print a line when none was for long."""
        del pl_module
        waited = time.monotonic() - self._seen
        if self.bar is not None and self.task is not None and waited > _REDRAW_S:
            state = f"{self.scores}  {_losses(trainer)}".strip()
            self.bar.update(self.task, completed=trainer.global_step, state=state)
            self._seen = time.monotonic()
        elif self.bar is None and waited > self.line_every_s:
            self._print(trainer)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Remember the scores, and print them where there is no bar."""
        del pl_module
        metrics = trainer.callback_metrics
        if "val/ap_10" not in metrics or trainer.sanity_checking:
            return
        self.scores = "AP " + "/".join(f"{float(metrics[f'val/ap_{k}']):.3f}" for k in (10, 5, 2))
        if self.bar is None:
            self._print(trainer)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Close the bar."""
        del pl_module
        if self.bar is not None and self.task is not None:
            self.bar.update(self.task, completed=trainer.global_step)
        self.seconds, self._start = self.total_seconds(), time.monotonic()
        self._close()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Close the bar, so that the terminal is left as it was."""
        del trainer, pl_module, exception
        self._close()

    def state_dict(self) -> dict[str, Any]:
        """The seconds so far and the last scores, for a continued training."""
        return {"seconds": self.total_seconds(), "scores": self.scores}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self.seconds, self.scores = float(state_dict["seconds"]), str(state_dict["scores"])
        self._start = time.monotonic()

    def total_seconds(self) -> float:
        """Seconds of training, those before an interruption included."""
        return self.seconds + time.monotonic() - self._start

    def _print(self, trainer: L.Trainer) -> None:
        done, total = trainer.global_step, _total(trainer)
        rate = (time.monotonic() - self._start) / max(1, done - self._first_step)
        scores = f", {self.scores} at 10/5/2 % D" if self.scores else ""
        print(
            f"step {done} of {total}: {_losses(trainer)}{scores}, {_duration(rate * (total - done))} left",
            file=sys.stderr,
            flush=True,
        )
        self._seen = time.monotonic()

    def _close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None


def _losses(trainer: L.Trainer) -> str:
    terms = {k.removeprefix(_LOSS): float(v) for k, v in trainer.callback_metrics.items() if k.startswith(_LOSS)}
    return " ".join(f"{name} {value:.2f}" for name, value in terms.items())


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _total(trainer: L.Trainer) -> int:
    return int(trainer.estimated_stepping_batches)
