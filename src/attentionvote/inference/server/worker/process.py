"""A worker from the server's side: started, given a bundle, asked one thing at a time, killed when it does not end."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from attentionvote.inference.bundles.bundle import Bundle
from attentionvote.inference.errors import BundleError
from attentionvote.inference.fetching.access import PASSWORD_VARIABLE, USER_VARIABLE
from attentionvote.inference.scans.limits import MOST_POINTS
from attentionvote.inference.server.deadline import Deadline
from attentionvote.inference.server.worker.channel import Channel, ChannelClosed, Message, SharedContent

# A job stops itself at its deadline; one that runs this much longer has lost control of itself.
OVERRUN_S = 1.0
_LAST_WORDS = 2000
_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "OpenBLAS error: Memory allocation")
Loss = Literal["deadline", "memory", "crashed"]


class WorkerLost(Exception):
    """The worker was killed or has ended, and what it did was lost.

    Attributes:
        reason: ``deadline`` (it did not stop), ``memory``, or ``crashed``.
        detail: a sentence for the log.
    """

    def __init__(self, reason: Loss, detail: str) -> None:
        super().__init__(detail)
        self.reason: Loss = reason
        self.detail = detail


class WorkerEnded(Exception):
    """The worker had ended before it was asked: nothing was lost."""


@dataclass(frozen=True)
class WorkerSettings:
    """How every worker of a server is set up.

    Attributes:
        threads: of an estimate.
        cell: content of the cell file; empty without.
        most_points: that a scan may have measured.
        job_memory_bytes: what a job may take beside the loaded model.
        load_s: seconds for loading and testing a bundle.
    """

    threads: int = 1
    cell: bytes = b""
    most_points: int = MOST_POINTS
    job_memory_bytes: int = 768 * 1024 * 1024
    load_s: float = 60.0


class WorkerProcess:
    """One worker process with one bundle. Methods may be called from any thread, one at a time.

    Args:
        bundle: verified; the worker gets these very bytes, whatever happens to the folder.
        settings: of the server's workers.
        self_test: whether the golden clouds must give their poses again.
        polite: whether loading gives way to requests.

    Raises:
        BundleError: when the bundle cannot be loaded or fails its test in the time for it.
        OSError: when there is no process or memory to be had.
    """

    def __init__(self, bundle: Bundle, settings: WorkerSettings, *, self_test: bool, polite: bool) -> None:
        self._busy_until: float | None = None
        self._handles = threading.Lock()
        self._open = True
        self._output = os.memfd_create("attentionvote-worker", os.MFD_CLOEXEC)
        try:
            self._start(settings.threads)
        except BaseException:
            os.close(self._output)
            raise
        try:
            self._load(bundle, settings, self_test, polite)
        except BaseException:
            self.kill()
            raise

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    @property
    def ended_idle(self) -> bool:
        """Whether the process has ended while nobody asked it anything."""
        return self._busy_until is None and not self.alive

    @property
    def overdue(self) -> bool:
        """Whether it works on something that should have ended."""
        until = self._busy_until
        return until is not None and time.monotonic() > until

    @property
    def memory_bytes(self) -> int:
        """Resident memory, shared contents included; 0 when it has ended."""
        with suppress(OSError, ValueError, IndexError):
            pages = Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1]
            return int(pages) * os.sysconf("SC_PAGE_SIZE")
        return 0

    def ask(
        self,
        job: dict[str, Any],
        content: SharedContent | None,
        deadline: Deadline,
    ) -> Message:
        """Let it do a job.

        Args:
            job: what to do, see ``jobs``.
            content: the request's body; None where the job needs none.
            deadline: of the job; takes the budget that the body names.

        Raises:
            WorkerEnded: it had ended before.
            WorkerLost: it was killed a second after the deadline, or ended by itself.
        """
        with self._handles:
            if not (self._open and self.alive):
                raise WorkerEnded
            self._expect(deadline)
        try:
            self._channel.send(job | {"budget_s": deadline.budget_s, "start": deadline.start}, content)
            return self._answer(deadline)
        except ChannelClosed as error:
            raise WorkerEnded from error
        finally:
            self._busy_until = None

    def _answer(self, deadline: Deadline) -> Message:
        """The answer to a job that was sent."""
        begun = False
        try:
            while True:
                self._expect(deadline)
                answer = self._channel.receive(deadline.remaining_s() + OVERRUN_S)
                if "status" in answer.head:
                    return answer
                begun = True
                if "budget_s" in answer.head:  # the body names another deadline
                    deadline.budget_s = float(answer.head["budget_s"])
        except TimeoutError as error:
            self._process.kill()
            raise WorkerLost("deadline", f"a job ran {OVERRUN_S:g} s beyond its deadline and was killed") from error
        except (ChannelClosed, TypeError, ValueError) as error:
            loss = self._post_mortem()
            if begun:
                raise loss from error
            raise WorkerEnded from error  # it was ending already, and has not seen the job

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # a process in a broken driver dies later
            self._process.wait(OVERRUN_S)
        with self._handles:
            if self._open and self._busy_until is None:  # else whoever asks it still holds them, and kills it as well
                self._open = False
                self._channel.close()
                os.close(self._lifeline)
                os.close(self._output)

    def _expect(self, deadline: Deadline) -> None:
        """It works on something that should have ended half an overrun after its deadline."""
        self._busy_until = time.monotonic() + max(deadline.remaining_s(), 0.0) + OVERRUN_S / 2

    def _start(self, threads: int) -> None:
        self._channel, inner = Channel.pair()
        reading, self._lifeline = os.pipe2(os.O_CLOEXEC)
        words = [sys.executable, "-P", "-m", "attentionvote.inference.server.worker.main"]
        words += [str(inner.fileno()), str(reading)]
        secrets = (USER_VARIABLE, PASSWORD_VARIABLE)
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                pass_fds=(inner.fileno(), reading),
                # One thread a worker but for those it was given: a machine of 64 cores would start as many in each.
                env={name: value for name, value in os.environ.items() if name not in secrets}
                | {"OPENBLAS_NUM_THREADS": str(threads)},
            )
        except BaseException:
            self._channel.close()
            os.close(self._lifeline)
            raise
        finally:
            inner.close()
            os.close(reading)

    def _load(self, bundle: Bundle, settings: WorkerSettings, self_test: bool, polite: bool) -> None:
        pieces = {
            "card": bundle.card.to_json().encode(),
            "cell": settings.cell,
            "model": bundle.model,
            **bundle.golden_files,
        }
        head = {
            "sizes": [len(piece) for piece in pieces.values()],
            "golden": list(bundle.golden_files),
            "digest": bundle.digest,
            "threads": settings.threads,
            "most_points": settings.most_points,
            "job_memory_bytes": settings.job_memory_bytes,
            "self_test": self_test,
            "polite": polite,
        }
        try:
            with SharedContent.of(*pieces.values()) as content:
                self._channel.send(head, content)
            answer = self._channel.receive(settings.load_s)
            problem = answer.head["problem"]
        except TimeoutError as error:
            raise BundleError(
                f"{bundle.path}: the self-test must end within {settings.load_s:g} s, but it did not: "
                "its graph does not end, or this machine is too slow for it (--self-test-s)"
            ) from error
        except (ChannelClosed, KeyError, TypeError, ValueError) as error:
            loss = self._post_mortem()
            if loss.reason == "memory":  # the machine's fault, and worth another try
                raise OSError(errno.ENOMEM, loss.detail) from error
            raise BundleError(f"{bundle.path}: loading it ended its process: {loss.detail}") from error
        if problem is not None:
            raise BundleError(f"{bundle.path}: {problem}" if self_test else str(problem))

    def _post_mortem(self) -> WorkerLost:
        """Why a worker that no longer answers has ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(OVERRUN_S)
        code = self._process.poll()
        words = self._last_words()
        self._process.kill()
        if code == -signal.SIGKILL or any(sign in words for sign in _OUT_OF_MEMORY):
            return WorkerLost("memory", f"the worker was ended, for its memory or by hand ({_ended(code)})")
        return WorkerLost("crashed", f"the worker {_ended(code)}{': ' if words else ''}{words}")

    def _last_words(self) -> str:
        """The end of what it has printed, in one line."""
        size = os.fstat(self._output).st_size
        tail = os.pread(self._output, _LAST_WORDS, max(size - _LAST_WORDS, 0))
        return " ".join(tail.decode("utf-8", "replace").split())


def _ended(code: int | None) -> str:
    if code is None:
        return "sent something that is no answer"
    return f"ended with {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
