"""One job in a process of its own, and both ends of it: what it answers comes back whole, it ends with its starter.

A job is a verb's script with its words: a crash costs one job, and its memory is freed when it ends. The job
leaves its JSON line and, when it fails, its sentence in files without names, so that a kill -9 leaves nothing behind.
Two variables of the environment tell it so: ``ATTENTIONVOTE_JOB_PARENT`` (the process id it ends with) and
``ATTENTIONVOTE_JOB_FAILURE`` (the descriptor of the file).
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
from typing import IO, Any, Protocol

PARENT, FAILURE = "ATTENTIONVOTE_JOB_PARENT", "ATTENTIONVOTE_JOB_FAILURE"
INTERRUPTED, TERMINATED = 130, 143  # exit codes after Ctrl-C and SIGTERM
# What a job reads of its environment, the passwords of study and tracking included.
_HANDED_ON = ("ATTENTIONVOTE_", "MLFLOW_TRACKING_", "PG")
_PR_SET_PDEATHSIG = 1  # of prctl(2)
_GRACE_S = 90.0  # for a job to end orderly after Ctrl-C


def handed_on() -> dict[str, str]:
    """Variables for a job that does not start from here: a worker of Ray has the environment of `ray start`."""
    return {name: value for name, value in os.environ.items() if name.startswith(_HANDED_ON)}


@dataclass(frozen=True)
class Outcome:
    """How a job ended: its exit ``code``, its ``result`` on success, else one ``sentence``."""

    code: int
    result: dict[str, Any] | None
    sentence: str


class JobFuture(Protocol):
    """A job that was started somewhere, as ``concurrent.futures`` has it; a failure is an outcome, not an exception."""

    def done(self) -> bool:
        """Whether the job has ended."""

    def result(self) -> Outcome:
        """How it ended; waits for that."""

    def cancel(self) -> None:
        """Have it end orderly."""

    def kill(self) -> None:
        """End it at once."""


class JobProcess:
    """A running job, a future of its outcome; start it in a thread that lives as long as the job may.

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
        self._outcome: Outcome | None = None
        self._stdout, self._failure = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
        both_ends = {PARENT: str(os.getpid()), FAILURE: str(self._failure.fileno())}
        try:
            # A session of its own: Ctrl-C reaches us alone, and we pass it on, once.
            self._process = subprocess.Popen(
                [sys.executable, str(script), *words],
                stdin=subprocess.DEVNULL,
                stdout=self._stdout,
                stderr=stderr,
                env={**os.environ, **(environment or {}), **both_ends},
                pass_fds=[self._failure.fileno()],
                start_new_session=True,
            )
        except BaseException:
            self._close()
            raise

    def done(self) -> bool:
        """Whether the job has ended."""
        return self._process.poll() is not None

    def result(self) -> Outcome:
        """Wait for the end; KeyboardInterrupt is passed on to the job and raised when it has ended."""
        if self._outcome is None:
            try:
                code = self._process.wait()
            except BaseException:
                cancel_all([self])
                raise
            self._outcome = self._read(code)
            self._close()
        return self._outcome

    def cancel(self) -> None:
        """Ctrl-C: the job may end orderly; nothing happens when it has ended."""
        self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End the job at once; nothing happens when it has ended."""
        self._process.kill()
        self.result()

    def _close(self) -> None:
        self._stdout.close()
        self._failure.close()

    def _read(self, code: int) -> Outcome:
        if code == 0:
            try:
                result = json.loads(_text(self._stdout).splitlines()[-1])
            except (ValueError, IndexError):
                result = None
            if isinstance(result, dict):
                return Outcome(0, result, "")
            return Outcome(1, None, "it ended without a result")
        sentence = _text(self._failure)
        if sentence:
            return Outcome(code, None, sentence)
        if code < 0:
            name = signal.Signals(-code).name if -code in signal.valid_signals() else str(-code)
            return Outcome(code, None, f"its process was ended by {name}" + " (out of memory?)" * (code == -9))
        return Outcome(code, None, f"its process ended with exit code {code}")


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode("utf-8", errors="replace")


def cancel_all(jobs: Sequence[JobFuture], grace_s: float = _GRACE_S) -> None:
    """Ctrl-C for jobs: each may end orderly, a second Ctrl-C or the end of the grace period ends them at once."""
    for job in jobs:
        job.cancel()
    deadline = time.monotonic() + grace_s
    try:
        while not all(job.done() for job in jobs) and time.monotonic() < deadline:
            time.sleep(0.05)
    except KeyboardInterrupt:
        pass
    finally:
        for job in jobs:
            job.kill()


def end_with_parent() -> None:
    """Have the kernel end this process, as by kill -9, when the one that started it ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def join_starter() -> None:
    """In a job: end (as by kill -9) when the process that started it ends, however it ends; elsewhere nothing.

    A training stands kill -9. An orphan that goes on would be in the way of the one that is started in its place.
    """
    starter = os.environ.pop(PARENT, None)
    if starter is None:
        return
    end_with_parent()
    if os.getppid() != int(starter):  # it has ended before we could say so
        os.kill(os.getpid(), signal.SIGKILL)


def report_failure(sentence: str) -> None:
    """In a job: leave the sentence it fails with; elsewhere nothing."""
    descriptor = os.environ.get(FAILURE)
    if descriptor is not None:
        os.write(int(descriptor), sentence.encode())
