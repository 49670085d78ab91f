"""Ctrl-C and SIGTERM, and what is raised on their way."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from attentionvote.command.interruption import Terminated, interruption


def raised_while(interrupt: type[BaseException], error: BaseException) -> BaseException:
    """An error that is raised while another one is handled."""
    try:
        try:
            raise interrupt
        except BaseException:
            raise error  # noqa: B904 - as a library does
    except BaseException as caught:
        return caught


@pytest.mark.parametrize(("interrupt", "code"), [(KeyboardInterrupt, 130), (Terminated, 143), (ValueError, None)])
def test_the_code_is_that_of_the_interruption_on_the_way(interrupt: type[BaseException], code: int | None) -> None:
    assert interruption(interrupt()) == code
    for error in (SystemExit(1), RuntimeError("DataLoader worker is killed by signal: Terminated.")):
        assert interruption(raised_while(interrupt, error)) == code
    assert interruption(SystemExit(0)) is None


def test_a_signal_that_comes_again_does_not_disturb_the_end() -> None:
    program = (
        "import os, signal; from attentionvote.command.interruption import *\n"
        "catch_sigterm()\n"
        "try: os.kill(os.getpid(), signal.SIGTERM)\n"
        "except Terminated:\n"
        "    os.kill(os.getpid(), signal.SIGTERM); print('ended orderly')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ended orderly\n", "")


def test_who_ignores_the_signal_goes_on_ignoring_it() -> None:
    program = (
        "import os, signal; from attentionvote.command.interruption import *\n"
        "catch_sigterm(); os.kill(os.getpid(), signal.SIGTERM); print('goes on')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN) and None,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "goes on\n")
