"""A trial's training where an executor's worker is: run there, and ended there when nobody waits for it any more."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from attentionvote.execution.job_process import JobProcess, Outcome, interrupt
from attentionvote.files import is_locked

_POLL_S = 0.1
_LOOK_S = 2.0  # between looks at the claim


@dataclass(frozen=True)
class TrialTask:
    """Runs the training in a process of its own; the task that the executor takes to its worker.

    Args:
        script: that trains.
        words: after it.
        environment: further variables of its process.
        log: file that its progress is added to, on a disk that all machines share.
        claim: folder that is locked as long as somebody waits for the answer. Ray ends a worker whose driver was
            killed; SLURM does not, so this is how it is told.
    """

    script: Path
    words: tuple[str, ...]
    environment: Mapping[str, str] = field(repr=False)
    log: Path
    claim: Path

    def __call__(self, number: int) -> Outcome:
        """How the training of the trial of this number ended.

        Raises:
            FileNotFoundError: when the study's folder is not on this machine.
        """
        if not self.log.parent.is_dir():
            raise FileNotFoundError(
                f"sweeps must be a folder that all machines share, but {socket.gethostname()}, the worker of trial "
                f"{number}, has no {self.log.parent}"
            )
        # Where machines do not see each other's locks, nothing can be told from them.
        watched = is_locked(self.claim)
        with self.log.open("ab") as log:
            process = JobProcess(self.script, self.words, log, self.environment)
            try:
                return self._end_of(process, watched)
            except BaseException:
                interrupt([process])
                raise

    def _end_of(self, process: JobProcess, watched: bool) -> Outcome:
        looked_s = time.monotonic()
        while (outcome := process.poll()) is None:
            time.sleep(_POLL_S)
            if watched and time.monotonic() - looked_s >= _LOOK_S:
                looked_s = time.monotonic()
                if not is_locked(self.claim):
                    process.kill()
        return outcome
