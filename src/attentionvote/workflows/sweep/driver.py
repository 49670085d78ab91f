"""Runs the trials of a study side by side, each an ordinary training in a process of its own."""

from __future__ import annotations

import logging
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, Trial, TrialState

from attentionvote.command.conf_folder import SCRIPTS
from attentionvote.execution.job_process import INTERRUPTED, JobProcess, Outcome, interrupt
from attentionvote.files import is_locked
from attentionvote.workflows.sweep.study import Ledger
from attentionvote.workflows.sweep.trial_place import PRUNED_AT, PRUNED_CODE, log_of

log = logging.getLogger("attentionvote.sweep")
TRAIN = SCRIPTS / "train.py"
_POLL_S = 0.1
_LOCK_S = 1.0  # between looks at a lock that somebody else holds
_ALIKE = 3  # new trials in a row that fail with one sentence: something is away, and it is not their settings
_HELD = "held"  # attribute of a trial that failed when the sweep stopped for that


@dataclass
class Running:
    """A trial whose process runs; no two have the same ``slot``."""

    trial: Trial
    directory: Path
    slot: int
    process: JobProcess
    files: ExitStack
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
        words: the words of the training with the given values of the searched settings.
        directory: the folder of that training.
        environment: of the process of the trial of this number, in this slot of ``workers``.
        workers: most trials at a time.
        retries: how often a trial whose process died is taken up again.
        heartbeat_s: between signs of life.
        logs: folder of what the trainings say.
        ended: called with every trial that has ended.
        script: of the process.
    """

    def __init__(
        self,
        ledger: Ledger,
        words: Callable[[Mapping[str, Any]], Sequence[str]],
        directory: Callable[[Mapping[str, Any]], Path],
        environment: Callable[[int, int], Mapping[str, str]],
        workers: int,
        retries: int,
        heartbeat_s: float,
        logs: Path,
        ended: Callable[[FrozenTrial], object],
        script: Path = TRAIN,
    ) -> None:
        self.ledger, self.words, self.directory, self.environment = ledger, words, directory, environment
        self.workers, self.retries, self.heartbeat_s = workers, retries, heartbeat_s
        self.logs, self.ended, self.script = logs, ended, script
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
            ValueError: when a sweep in another place is at this study, or when trials fail in a row with one sentence;
                these are begun and not ended then, so that the next call takes them up.
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
            interrupt([running.process for running in self.running])
            for running in self.running:
                running.files.close()

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
        files = ExitStack()
        stderr = files.enter_context(log_of(self.logs, trial.number).open("ab"))
        slot = min(set(range(self.workers)) - {running.slot for running in self.running})
        process = JobProcess(self.script, self.words(values), stderr, self.environment(trial.number, slot))
        self.running.append(Running(trial, directory, slot, process, files))

    def _collect(self) -> None:
        for running in list(self.running):
            outcome = running.process.poll()
            if outcome is None:
                continue
            self.running.remove(running)
            running.files.close()
            self._judge(running, outcome)

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
        elif outcome.code < 0 and self.ledger.crashed(trial) <= self.retries:
            log.warning("trial %d is taken up again: %s", trial.number, outcome.sentence)
            trial.set_user_attr("seconds", about["seconds"])
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
        for one in self.failing:
            one.trial.set_user_attr(_HELD, one.reason)
        numbers = ", ".join(str(one.trial.number) for one in self.failing)
        raise ValueError(
            f"the sweep stops, because trials {numbers} failed in a row with the same sentence; the same command takes "
            f"them up again when its cause is gone: {failing.reason}"
        )

    def _settle(self) -> None:
        """Write down what failed: another trial ended otherwise, or there is none left."""
        for one in self.failing:
            self._end(one.trial, one.directory, TrialState.FAIL, reason=one.reason, **one.about)
        self.failing = []

    def _end(
        self, trial: Trial, directory: Path | None, state: TrialState, value: float | None = None, **about: Any
    ) -> None:
        # For whoever looks at the study with another tool; relative, as the settings are.
        place = {} if directory is None else {"directory": os.fspath(directory)}
        self.ledger.end(trial, state, value, **place, **about)
        self.ended(self.ledger.trials[trial.number])

    def _beat(self) -> None:
        if time.monotonic() - self._beaten_s >= self.heartbeat_s:
            begun = [running.trial for running in self.running] + [failing.trial for failing in self.failing]
            self.ledger.beat(begun + [trial for trial, _, _ in self.waiting])
            self._beaten_s = time.monotonic()


def _kind(sentence: str) -> str:
    """A sentence without the words that hold a digit: numbers, digests, addresses, files of this very process."""
    return re.sub(r"\S*\d\S*", "", sentence)
