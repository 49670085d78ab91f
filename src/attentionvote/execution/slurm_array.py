"""Jobs as a job array of SLURM, through submitit.

An element of the array is a worker: it takes its share of the jobs one after the other and leaves every outcome as a
file in a shared folder, where this process finds it. So a result counts when it is there, and an element that ends
early costs the one job that it was at.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import pickle
import shutil
import time
import uuid
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from attentionvote.execution.failures import Attempts
from attentionvote.execution.outcome import inherited, perform, worker_environment

_ELEMENTS = 1000  # SLURM's MaxArraySize is 1001 where nobody has changed it
_END_S = 10.0  # what processes of this machine get to end
_SHARES = 4  # elements a worker: evens out jobs of unequal length


@dataclass(frozen=True)
class SlurmArray:
    """A SLURM cluster whose machines share this machine's files.

    Args:
        folder: where jobs, outcomes and logs lie while they run; shared.
        system: ``slurm``, or ``local``: processes of this machine, as a rehearsal.
        minutes: time limit of an element of the array.
        memory_gb: of an element; None is the partition's default.
        partition, account: of sbatch; None is the cluster's default. Other options: the SBATCH_ variables of sbatch.
        gpus: GPUs an element takes.
        poll_s: seconds between two looks into the folder.
        settle_s: how long an outcome of an ended element may take to become visible here (NFS).
    """

    folder: Path
    system: str = "slurm"
    minutes: int = 240
    memory_gb: float | None = None
    partition: str | None = None
    account: str | None = None
    gpus: float = 0
    poll_s: float = 2.0
    settle_s: float = 60.0

    def check(self) -> None:
        """Whether submitit and sbatch are there.

        Raises:
            ValueError: when they are not.
        """
        if self.system not in ("slurm", "local"):
            raise ValueError(f"cluster.slurm.system must be slurm or local; got {self.system!r}")
        if importlib.util.find_spec("submitit") is None:
            raise ValueError(
                "executor=slurm needs the package submitit, which is not installed: install the extra cluster "
                "(pip install '.[cluster]'), or choose executor=local"
            )
        if self.system == "slurm" and shutil.which("sbatch") is None:
            raise ValueError(
                "executor=slurm must be used where jobs can be submitted, but there is no sbatch here: log in to a "
                "submit host, or choose executor=local"
            )
        if self.gpus != int(self.gpus):
            raise ValueError(f"cluster.gpus must be a whole number with executor=slurm; got {self.gpus:g}")

    def outcomes(
        self, task: Callable[[Any], Any], jobs: Sequence[Any], workers: int, retries: int, threads: int
    ) -> Generator[tuple[int, bytes], None, None]:
        """See ``Executor``; the folder of a call that failed stays for its logs."""
        call = self.folder.absolute() / uuid.uuid4().hex[:12]
        (call / "outcomes").mkdir(parents=True)
        call.chmod(0o700)  # jobs may hold the environment they run in
        (call / "task.pkl").write_bytes(pickle.dumps(task))
        run = _Run(self, call, jobs, workers, Attempts(retries, len(jobs)), threads)
        try:
            yield from run.outcomes()
        finally:
            run.cancel()
        shutil.rmtree(call, ignore_errors=True)


class _Run:
    def __init__(
        self, array: SlurmArray, call: Path, jobs: Sequence[Any], workers: int, attempts: Attempts, threads: int
    ) -> None:
        self.array, self.call, self.jobs, self.workers = array, call, jobs, workers
        self.attempts, self.threads = attempts, threads
        self.missing = set(range(len(jobs)))
        self.elements: dict[Any, list[int]] = {}  # submitit's job -> the jobs it has to do, in order
        self.ended: dict[Any, float] = {}

    def outcomes(self) -> Generator[tuple[int, bytes], None, None]:
        """Index and outcome of every job."""
        shares = self.workers * (1 if self.array.system == "local" else _SHARES)
        self._submit(sorted(self.missing), min(len(self.jobs), shares, _ELEMENTS))
        while self.missing:
            before = len(self.missing)
            yield from self._arrived()
            lost = self._lost()
            if lost:
                self._submit(sorted(lost), min(len(lost), self.workers))
            elif len(self.missing) == before:
                time.sleep(self.array.poll_s)

    def cancel(self) -> None:
        """End what still works on a job."""
        for element, share in self.elements.items():
            if self.missing.intersection(share):
                element.cancel(check=False)
        deadline = time.monotonic() + _END_S
        while self.array.system == "local" and time.monotonic() < deadline:
            if all(element.done() for element in self.elements):
                break
            time.sleep(0.02)

    def _arrived(self) -> Generator[tuple[int, bytes], None, None]:
        for path in sorted((self.call / "outcomes").glob("[0-9]*")):
            index = int(path.name)
            if index in self.missing:
                self.missing.remove(index)
                self.attempts.finished += 1
                yield index, path.read_bytes()
                path.unlink()

    def _lost(self) -> list[int]:
        """Jobs of elements that ended without them; the first of each element was the one it died at."""
        lost: list[int] = []
        for element, share in list(self.elements.items()):
            left = [index for index in share if index in self.missing]
            if (left or self.array.system == "local") and not element.done():
                continue  # processes of this machine are waited for in any case
            if left and time.monotonic() - self.ended.setdefault(element, time.monotonic()) < self._settle_s():
                continue
            if any((self.call / "outcomes" / str(index)).exists() for index in left):
                continue  # it came between the two looks
            del self.elements[element]
            if left:
                self.attempts.died(left[0], f"SLURM job {element.job_id}, {element.state.lower()}")
                lost += left
        return lost

    def _settle_s(self) -> float:
        return 0.0 if self.array.system == "local" else self.array.settle_s

    def _submit(self, indices: list[int], elements: int) -> None:
        import submitit

        logging.getLogger("submitit").setLevel(logging.ERROR)
        executor = submitit.AutoExecutor(folder=self.call / "log_%j", cluster=self.array.system)
        executor.update_parameters(**self._parameters())
        shares = [indices[start::elements] for start in range(elements)]
        with inherited(worker_environment(self.threads)), executor.batch():
            submitted = [
                executor.submit(_Element(self.call, [(i, pickle.dumps(self.jobs[i])) for i in share]))
                for share in shares
            ]
        self.elements |= dict(zip(submitted, shares, strict=True))

    def _parameters(self) -> dict[str, Any]:
        array = self.array
        parameters: dict[str, Any] = {"timeout_min": array.minutes, "gpus_per_node": int(array.gpus)}
        if array.system == "slurm":
            parameters |= {
                "cpus_per_task": self.threads,
                "mem_gb": array.memory_gb,
                "slurm_partition": array.partition,
                "slurm_account": array.account,
                "slurm_array_parallelism": self.workers,
            }
        return {name: value for name, value in parameters.items() if value is not None}


@dataclass(frozen=True)
class _Element:
    """What an element of the array does: its share of the jobs, every outcome a file that appears whole."""

    call: Path
    share: list[tuple[int, bytes]]

    def __call__(self) -> None:
        task = cache(partial(pickle.loads, (self.call / "task.pkl").read_bytes()))
        for index, job in self.share:
            outcome = perform(task, job)
            temporary = self.call / "outcomes" / f".{index}.{os.getpid()}"
            temporary.write_bytes(outcome)
            temporary.replace(self.call / "outcomes" / str(index))
