"""Verbs as jobs: started as processes of this machine, or by an executor where one of its workers is."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from attentionvote.execution.failures import WorkerDied
from attentionvote.execution.job_process import (
    INTERRUPTED,
    TERMINATED,
    JobFuture,
    JobProcess,
    Outcome,
    cancel_all,
    handed_on,
    join_starter,
    report_failure,
)
from attentionvote.execution.run import executor_named, run_all
from attentionvote.files import is_locked, locked_folder

_WORKER_JOB = "ATTENTIONVOTE_WORKER_JOB"  # what the process behind a future is about
_POLL_S = 0.1
_CLAIM_S = 2.0  # between looks at the claim


@dataclass(frozen=True)
class LocalJobs:
    """Each job a process of this machine.

    Args:
        script: of the verb.
    """

    script: Path

    def submit(self, words: Sequence[str], log: Path, environment: Mapping[str, str]) -> JobFuture:
        """Start a job.

        Args:
            words: after the verb's script.
            log: file that its progress is added to.
            environment: further variables.
        """
        with log.open("ab") as stderr:
            return JobProcess(self.script, words, stderr, environment)


@dataclass(frozen=True)
class WorkerJobs:
    """Each job a process where an executor's worker is.

    Ray and submitit have one driver a process, and a driver's death is what ends its workers: behind each future is
    one process of this machine that hands the job on and passes its answer back.

    Args:
        script: of the verb.
        executor, cluster: see ``executor_named``.
        threads: cores of a job.
    """

    script: Path
    executor: str
    cluster: Mapping[str, Any]
    threads: int

    def submit(self, words: Sequence[str], log: Path, environment: Mapping[str, str]) -> JobFuture:
        """See ``LocalJobs``; the log is on a disk that the worker sees."""
        about = {"executor": self.executor, "cluster": dict(self.cluster), "threads": self.threads}
        about |= {"script": str(self.script), "log": str(log.absolute())}
        return LocalJobs(Path(__file__)).submit(words, log, {**environment, _WORKER_JOB: json.dumps(about)})


JobExecutor: TypeAlias = LocalJobs | WorkerJobs  # where the jobs of one verb are started


@dataclass(frozen=True)
class WorkerTask:
    """What the executor takes to its worker: runs the verb in a process there, ends it when nobody waits any more.

    Args:
        script: of the verb.
        words: after it.
        environment: further variables of its process.
        claim: folder that is locked as long as somebody waits for the answer. Ray ends a worker whose driver was
            killed; SLURM does not, so the lock is how its worker learns of that.
    """

    script: Path
    words: tuple[str, ...]
    environment: Mapping[str, str] = field(repr=False)
    claim: Path

    def __call__(self, log: Path) -> Outcome:
        """How the job with this log ended.

        Raises:
            FileNotFoundError: when the log's folder is not on this machine.
        """
        if not log.parent.is_dir():
            raise FileNotFoundError(
                f"{log.parent} must be a folder that all machines share, but {socket.gethostname()}, the worker of "
                f"{log.stem}, does not have it"
            )
        # Where machines do not see each other's locks, an open one means nothing.
        watched = is_locked(self.claim)
        with log.open("ab") as stderr:
            process = JobProcess(self.script, self.words, stderr, self.environment)
        try:
            look_s = time.monotonic()
            while not process.done():
                time.sleep(_POLL_S)
                if watched and time.monotonic() - look_s >= _CLAIM_S:
                    look_s = time.monotonic()
                    if not is_locked(self.claim):
                        process.kill()
            return process.result()
        except BaseException:
            cancel_all([process])
            raise


def main() -> int:
    """The process behind a future of ``WorkerJobs``: to whoever started it what the job itself is; the exit code.

    When worker or job died, it ends by SIGKILL too. When it is ended, so is the job.
    """
    join_starter()
    about = json.loads(os.environ.pop(_WORKER_JOB))
    log = Path(about["log"])
    task = WorkerTask(Path(about["script"]), tuple(sys.argv[1:]), handed_on(), log.with_suffix(""))
    try:
        executor = executor_named(about["executor"], about["cluster"])
        with locked_folder(task.claim, str(task.claim), "job"):
            ((_, outcome),) = run_all(task, [log], executor, retries=0, threads=about["threads"])
    except KeyboardInterrupt:
        return INTERRUPTED
    except WorkerDied as error:
        outcome = Outcome(-signal.SIGKILL, None, f"its worker died ({error.how})")
    except Exception as error:
        outcome = Outcome(1, None, " ".join(str(error).split()) or type(error).__name__)
    if outcome.result is not None:
        print(json.dumps(outcome.result), flush=True)
        return 0
    report_failure(outcome.sentence)
    # An interruption there is not ours: the machine was taken away.
    if outcome.code < 0 or outcome.code in (INTERRUPTED, TERMINATED):
        os.kill(os.getpid(), signal.SIGKILL)
    return outcome.code


if __name__ == "__main__":
    # Under its own name: what is pickled here is looked up there. This folder's modules are no top-level ones.
    sys.path[:] = [path for path in sys.path if path != str(Path(__file__).parent)]
    from attentionvote.execution import job_executors

    sys.exit(job_executors.main())
