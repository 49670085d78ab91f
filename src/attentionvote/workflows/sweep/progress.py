"""The progress of a sweep: one bar over all trials with the time left and the best so far, a line a trial."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from attentionvote.workflows.sweep.report import trial_row
from attentionvote.workflows.sweep.space import Setting

_REDRAW_S = 1.0


class SweepProgress:
    """A bar on stderr while the block runs; where stderr is no terminal only the lines.

    Args:
        total: trials in all.
        done: that have ended before.
        workers: trials side by side.
        space: the settings that are searched.
    """

    def __init__(
        self, total: int, done: int, workers: int, space: Sequence[Setting], console: Console | None = None
    ) -> None:
        self.total, self.done, self.workers, self.space = total, done, workers, space
        self.console = console or Console(stderr=True)
        self.best = ""
        self._first, self._start_s, self._drawn_s = done, time.monotonic(), 0.0
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> SweepProgress:
        if self.console.is_terminal:
            columns = (TextColumn("trials"), BarColumn(20), TextColumn("{task.completed}/{task.total}"))
            state = TextColumn("{task.fields[state]}")
            self._bar = Progress(*columns, TimeElapsedColumn(), state, console=self.console)
            self._task = self._bar.add_task("", total=self.total, completed=self.done, state="")
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def tick(self) -> None:
        """Redraw now and then."""
        now = time.monotonic()
        if self._bar is not None and self._task is not None and now - self._drawn_s > _REDRAW_S:
            left = self.left()
            self._bar.update(self._task, completed=self.done, state=f"{left}{', ' * bool(left)}{self.best}")
            self._drawn_s = now

    def ended(self, trial: FrozenTrial, best: FrozenTrial | None) -> None:
        """Say how a trial ended."""
        self.done += 1
        if best is not None:
            self.best = f"best {best.value:.4f} (trial {best.number})"
        row = trial_row(trial, self.space)
        ending = {
            TrialState.COMPLETE: lambda: f"val/ap {trial.value:.4f}",
            TrialState.PRUNED: lambda: f"pruned at {row['last_val_ap'] or 0:.4f} after {row['epochs']} epochs",
        }.get(trial.state, lambda: f"failed: {row['reason']}")()
        values = " ".join(f"{s.name}={_short(row.get(s.name))}" for s in self.space)
        estimate = "; ".join(part for part in (self.best, self.left()) if part)
        line = f"trial {trial.number} ({self.done} of {self.total}): {ending}; {values}; {estimate}"
        if self._bar is not None:
            self._bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
        else:
            print(line, file=sys.stderr, flush=True)

    def left(self) -> str:
        """The time left as a text, empty before the first trial has ended."""
        ended, missing = self.done - self._first, self.total - self.done
        if not ended or missing <= 0:
            return ""
        # The pace of this call, parallel trials included.
        seconds = (time.monotonic() - self._start_s) / ended * missing
        return f"{seconds:.0f} s left" if seconds < 120 else f"{seconds / 60:.0f} min left"


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
