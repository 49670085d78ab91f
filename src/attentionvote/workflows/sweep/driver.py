"""Runs the trials of a study side by side, each an ordinary training in a process of its own."""

from __future__ import annotations

import logging
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, Trial, TrialState

from attentionvote.execution.job_executors import JobExecutor
from attentionvote.execution.job_process import INTERRUPTED, TERMINATED, JobFuture, Outcome, cancel_all
from attentionvote.files import is_locked
from attentionvote.workflows.sweep.settings import PRUNED_AT, PRUNED_CODE
from attentionvote.workflows.sweep.study import Ledger

log = logging.getLogger("attentionvote.sweep")
_POLL_S = 0.1
_LOCK_S = 1.0  # between looks at a lock that somebody else holds
_ALIKE = 3  # new trials in a row that fail with one sentence: something is away, and it is not their settings
_HELD = "held"  # attribute of a trial that failed when the sweep stopped for that


@dataclass
class Running:
    """A trial whose training runs; no two have the same ``slot``."""

    trial: Trial
    directory: Path
    slot: int
    job: JobFuture
    start_s: float = field(default_factory=time.monotonic)


@dataclass
class Failing:
    """A trial that has failed, not written down as long as it may be one of a row of failures with one cause."""

    trial: Trial
    directory: Path
    reason: str
    about: dict[str, Any]


class SweepDriver:
    """Brings a study to its total.

    Args:
        ledger: of the study.
        jobs: what starts trainings.
        words: the words of the training with the given values of the searched settings.
        directory: the folder of that training.
        environment: of the training of the trial of this number, in this slot of ``workers``.
        workers: most trials at a time.
        retries: how often a trial whose process died is taken up again.
        logs: folder of what the trainings say.
        ended: called with every trial that has ended.
    """

    def __init__(
        self,
        ledger: Ledger,
        jobs: JobExecutor,
        words: Callable[[Mapping[str, Any]], Sequence[str]],
        directory: Callable[[Mapping[str, Any]], Path],
        environment: Callable[[int, int], Mapping[str, str]],
        workers: int,
        retries: int,
        logs: Path,
        ended: Callable[[FrozenTrial], object],
    ) -> None:
        self.ledger, self.jobs, self.words = ledger, jobs, words
        self.directory, self.environment = directory, environment
        self.workers, self.retries, self.logs, self.ended = workers, retries, logs, ended
        self.running: list[Running] = []
        self.lost: deque[FrozenTrial] = deque()
        self.waiting: deque[tuple[Trial, dict[str, Any], Path]] = deque()  # somebody else is at their training
        self.failing: list[Failing] = []
        self._beaten_s = self._looked_s = -float("inf")

    def run(self, total: int, tick: Callable[[], object]) -> None:
        """Run until the study has ``total`` trials and all of them have ended.

        Args:
            total: trials in all, those of earlier calls included.
            tick: called ten times a second.

        Raises:
            ValueError: when a sweep in another place is at this study or has taken it over, or when trials fail in a
                row with one sentence; these are begun and not ended then, so that the next call takes them up.
            KeyboardInterrupt: after the trials that run have ended orderly; they go on with the next call.
        """
        self.lost = deque(self.ledger.lost())
        self.logs.mkdir(parents=True, exist_ok=True)
        try:
            while True:
                self._start(total)
                if not self.running and not self.waiting and not self.lost:
                    self._settle()
                    return
                time.sleep(_POLL_S)
                self._collect()
                self._beat()
                tick()
        finally:
            cancel_all([running.job for running in self.running])

    def _start(self, total: int) -> None:
        if time.monotonic() - self._looked_s >= _LOCK_S:
            self._looked_s = time.monotonic()
            for _ in range(len(self.waiting)):
                self._launch_or_wait(*self.waiting.popleft())
        while len(self.running) + len(self.waiting) < self.workers:
            lost: FrozenTrial | None = None
            if self.lost:
                lost = self.lost.popleft()
                trial, values = self.ledger.begin(lost)
            elif len(self.ledger.trials) < total:
                trial, values = self.ledger.begin()
            else:
                return
            try:
                directory = self.directory(values)
            except (ValueError, OSError) as error:  # each value is fine alone, but not all of them together
                self._end(trial, None, TrialState.FAIL, reason=" ".join(str(error).split()))
                continue
            if lost is not None and PRUNED_AT in lost.user_attrs:  # decided, but nobody was there to write it down
                self._end(trial, directory, TrialState.PRUNED)
                continue
            self._launch_or_wait(trial, values, directory)

    def _launch_or_wait(self, trial: Trial, values: dict[str, Any], directory: Path) -> None:
        # Another trial with the same values, or what a killed sweep left for some seconds.
        taken = any(running.directory == directory for running in self.running) or is_locked(directory)
        if taken or len(self.running) >= self.workers:
            self.waiting.append((trial, values, directory))
            return
        self.ledger.check()  # where a sweep goes on after a pause, the training may be another's by now
        slot = min(set(range(self.workers)) - {running.slot for running in self.running})
        log_file = self.logs / f"trial_{trial.number:03d}.log"
        job = self.jobs.submit(self.words(values), log_file, self.environment(trial.number, slot))
        self.running.append(Running(trial, directory, slot, job))

    def _collect(self) -> None:
        for running in list(self.running):
            if running.job.done():
                self.running.remove(running)
                self._judge(running, running.job.result())

    def _judge(self, running: Running, outcome: Outcome) -> None:
        trial, seconds = running.trial, round(time.monotonic() - running.start_s, 1)
        about = {"seconds": round(float(trial.user_attrs.get("seconds", 0)) + seconds, 1)}
        if outcome.code == INTERRUPTED:
            raise KeyboardInterrupt
        if outcome.code == PRUNED_CODE:
            self._settle()
            self._end(trial, running.directory, TrialState.PRUNED, **about)
        elif outcome.result is not None:
            value = outcome.result.get("val_ap")
            about |= {"test": outcome.result.get("metrics", {})}
            if value is None:
                reason = "its training has no val/ap: it was made before there were sweeps, train it with force=true"
                self._fail(Failing(trial, running.directory, reason, about))
            else:
                self._settle()
                self._end(trial, running.directory, TrialState.COMPLETE, float(value), **about)
        elif (outcome.code < 0 or outcome.code == TERMINATED) and self.ledger.crashed(trial) <= self.retries:
            log.warning("trial %d is taken up again: %s", trial.number, outcome.sentence)
            self.ledger.note(trial, seconds=about["seconds"])
            self.lost.append(self.ledger.trials[trial.number])
        else:
            self._fail(Failing(trial, running.directory, outcome.sentence, about))

    def _fail(self, failing: Failing) -> None:
        """A trial failed by itself: its settings or, when those before it said the same, something they all need."""
        if self.failing and _kind(self.failing[-1].reason) != _kind(failing.reason):
            self._settle()
        self.failing.append(failing)
        # Those held before do not count: were it their settings after all, the study would never get past them.
        if sum(_HELD not in f.trial.user_attrs for f in self.failing) < _ALIKE:
            return
        for held in self.failing:
            self.ledger.note(held.trial, **{_HELD: held.reason})
        numbers = ", ".join(str(held.trial.number) for held in self.failing)
        raise ValueError(
            f"the sweep stops, because trials {numbers} failed in a row with the same sentence; the same command takes "
            f"them up again when its cause is gone: {failing.reason}"
        )

    def _settle(self) -> None:
        """Write down what failed: another trial ended otherwise, or there is none left."""
        for failing in self.failing:
            self._end(failing.trial, failing.directory, TrialState.FAIL, reason=failing.reason, **failing.about)
        self.failing = []

    def _end(
        self, trial: Trial, directory: Path | None, state: TrialState, value: float | None = None, **about: Any
    ) -> None:
        # For whoever looks at the study with another tool; relative, as the settings are.
        folder = {} if directory is None else {"directory": os.fspath(directory)}
        self.ledger.end(trial, state, value, **folder, **about)
        self.ended(self.ledger.trials[trial.number])

    def _beat(self) -> None:
        if time.monotonic() - self._beaten_s >= self.ledger.heartbeat_s:
            self.ledger.beat()
            self._beaten_s = time.monotonic()


def _kind(sentence: str) -> str:
    """A sentence without the words that hold a digit: numbers, digests, addresses, files of this very process."""
    return re.sub(r"\S*\d\S*", "", sentence)
