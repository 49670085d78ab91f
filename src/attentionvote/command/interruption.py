"""The two ways in which a verb is interrupted: Ctrl-C, and SIGTERM of whoever manages the machine."""

from __future__ import annotations

import signal
from types import FrameType

from attentionvote.execution.job_process import INTERRUPTED, TERMINATED


class Terminated(KeyboardInterrupt):
    """SIGTERM; what is ready for Ctrl-C is ready for it too, and only the exit code is another."""


def catch_sigterm() -> None:
    """From now on SIGTERM interrupts this process as Ctrl-C does, unless it is ignored or somebody handles it."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def ignore_sigterm() -> None:
    """From now on SIGTERM changes nothing: this process is at its end, and says why."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def interruption(error: BaseException) -> int | None:
    """The exit code of a verb that this exception ends; None when it was no interruption.

    What is raised while an interruption is on its way is part of it: Lightning answers Ctrl-C with ``exit(1)``, and a
    signal for the whole group also ends loader processes, which torch reports as an error.
    """
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__context__
    if cause is None:
        return None
    return TERMINATED if isinstance(cause, Terminated) else INTERRUPTED


def _terminate(_: int, __: FrameType | None) -> None:
    ignore_sigterm()  # managers repeat it; what is stuck they end by SIGKILL
    raise Terminated
