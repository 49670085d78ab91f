"""Several processes of one training, started by torchrun; one cause when they fail."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING

from attentionvote.execution.job_process import INTERRUPTED

if TYPE_CHECKING:
    from torch.distributed.elastic.multiprocessing.errors import ProcessFailure


def main() -> int:
    """Run torchrun; the exit code."""
    # torchrun would set it too, and warn of it; trainer.threads says how many threads a process takes.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("LOGLEVEL", "CRITICAL")  # torchrun's own: that it ends the processes that are left
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.run import main as torchrun

    logging.getLogger("torch.distributed").setLevel(logging.CRITICAL)
    try:
        _check_processes(sys.argv[1:])
        torchrun()
    except SignalException as ended:
        if ended.sigval == signal.SIGINT:  # it reached the processes too, and the first one said so
            return INTERRUPTED
        print("train: interrupted; run the same command to resume", file=sys.stderr)
        return 128 + int(ended.sigval)
    except ChildFailedError as error:
        rank, first = _cause(error.failures)
        if first.exitcode < 0:
            name = signal.Signals(-first.exitcode).name
            print(f"train: process {rank + 1} was ended by {name}", file=sys.stderr)
            return 128 - first.exitcode
        return first.exitcode
    except ValueError as error:
        print(f"train: {error}", file=sys.stderr)
        return 2
    except Exception as error:
        print(f"train: torchrun failed: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
        return 1
    return 0


def _cause(failures: Mapping[int, ProcessFailure]) -> tuple[int, ProcessFailure]:
    """Rank and failure of the process that the others ended after.

    What a signal has ended comes first: when torchrun looks, another process may have ended for want of it already.
    """

    def order(rank: int) -> tuple[bool, float]:
        return failures[rank].exitcode >= 0, failures[rank].timestamp

    rank = min(failures, key=order)
    return rank, failures[rank]


def _check_processes(words: list[str]) -> None:
    """Whether the number of processes is one; torchrun also knows words for it.

    Raises:
        ValueError: when it is not.
    """
    for word in words:
        name, _, asked = word.partition("=")
        if name != "--nproc-per-node" or asked in ("auto", "cpu", "gpu", "xpu"):
            continue
        if not (asked.isdecimal() and int(asked) > 0):
            raise ValueError(f"PROCESSES must be a whole number of at least 1, got {asked or 'nothing'}")
