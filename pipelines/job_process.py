"""One job in a process of its own, and both ends of it: what it answers comes back whole, it ends with its starter.

A job is a verb's script with its words: a crash costs one job, and its memory is freed when it ends. The job
leaves its JSON line and, when it fails, its sentence in files; two variables of the environment tell it so:
``ATTENTIONVOTE_JOB_PARENT`` (the process id it ends with) and ``ATTENTIONVOTE_JOB_FAILURE`` (the file).
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

PARENT, FAILURE = "ATTENTIONVOTE_JOB_PARENT", "ATTENTIONVOTE_JOB_FAILURE"
INTERRUPTED = 130
_PR_SET_PDEATHSIG = 1  # of prctl(2)
_GRACE_S = 90.0  # for a job to end orderly after Ctrl-C


@dataclass(frozen=True)
class Outcome:
    """How a job ended: its exit ``code``, its ``result`` on success, else one ``sentence``."""

    code: int
    result: dict[str, Any] | None
    sentence: str


class JobProcess:
    """A running job; start it in a thread that lives as long as the job may.

    Args:
        script: of the verb.
        words: after it.
        stderr: where its progress goes; None for our own stderr.
        environment: further variables.
    """

    def __init__(
        self,
        script: Path | str,
        words: Sequence[str],
        stderr: IO[Any] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="attentionvote-job-")
        self._failure = Path(self._folder.name) / "failure"
        self._stdout = Path(self._folder.name) / "stdout"
        own = {PARENT: str(os.getpid()), FAILURE: str(self._failure)}
        with self._stdout.open("wb") as stdout:
            # A session of its own: Ctrl-C reaches us alone, and we pass it on, once.
            self._process = subprocess.Popen(
                [sys.executable, str(script), *words],
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                env={**os.environ, **(environment or {}), **own},
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def poll(self) -> Outcome | None:
        """How the job ended, None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        return self._outcome(code)

    def wait(self) -> Outcome:
        """Wait for the end; KeyboardInterrupt is passed on to the job and raised when it has ended."""
        try:
            return self._outcome(self._process.wait())
        except KeyboardInterrupt:
            interrupt([self])
            raise

    def signal(self, number: int) -> None:
        """Send a signal; nothing happens when the job has ended."""
        self._process.send_signal(number)

    def _outcome(self, code: int) -> Outcome:
        if code == 0:
            try:
                lines = self._stdout.read_text(encoding="utf-8").splitlines()
                result = json.loads(lines[-1])
            except (OSError, ValueError, IndexError):
                result = None
            if isinstance(result, dict):
                return Outcome(0, result, "")
            return Outcome(1, None, "it ended without a result")
        if self._failure.is_file():
            return Outcome(code, None, self._failure.read_text(encoding="utf-8"))
        if code < 0:
            name = signal.Signals(-code).name if -code in signal.valid_signals() else str(-code)
            return Outcome(code, None, f"its process was ended by {name}" + " (out of memory?)" * (code == -9))
        return Outcome(code, None, f"its process ended with exit code {code}")


def interrupt(jobs: Sequence[JobProcess], grace_s: float = _GRACE_S) -> None:
    """Ctrl-C for jobs: each may end orderly, a second Ctrl-C or the end of the grace period ends them at once."""
    for job in jobs:
        job.signal(signal.SIGINT)
    deadline = time.monotonic() + grace_s
    try:
        while any(job.poll() is None for job in jobs) and time.monotonic() < deadline:
            time.sleep(0.05)
    except KeyboardInterrupt:
        pass
    finally:
        for job in jobs:
            if job.poll() is None:
                job.signal(signal.SIGKILL)


def join_starter() -> None:
    """In a job: end (as by kill -9) when the process that started it ends, however it ends; elsewhere nothing.

    A training stands kill -9. An orphan that goes on would be in the way of the one that is started in its place.
    """
    starter = os.environ.pop(PARENT, None)
    if starter is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(starter):  # it has ended before we could say so
        os.kill(os.getpid(), signal.SIGKILL)


def report_failure(sentence: str) -> None:
    """In a job: leave the sentence it fails with; elsewhere nothing."""
    place = os.environ.get(FAILURE)
    if place is not None:
        Path(place).write_text(sentence, encoding="utf-8")
