"""The one call, and the names of its executors."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from attentionvote.execution.local_pool import LocalPool
from attentionvote.execution.outcome import result_of
from attentionvote.execution.ray_cluster import RayCluster
from attentionvote.execution.slurm_array import SlurmArray

Job = TypeVar("Job")
Result = TypeVar("Result")
EXECUTORS = ("local", "ray", "slurm")


class Executor(Protocol):
    """Where jobs run."""

    def check(self) -> None:
        """Whether it can work here.

        Raises:
            ValueError: with one sentence.
        """

    def outcomes(
        self, task: Callable[[Any], Any], jobs: Sequence[Any], workers: int, retries: int, threads: int
    ) -> Generator[tuple[int, bytes], None, None]:
        """Index and outcome (see ``outcome.perform``) of every job, each once, in the order in which they end.

        Closing the generator ends all workers.
        """
        ...


def run_all(
    task: Callable[[Job], Result],
    jobs: Sequence[Job],
    executor: Executor | None = None,
    *,
    workers: int = 1,
    retries: int = 2,
    threads: int = 1,
) -> Generator[tuple[int, Result], None, None]:
    """Do all jobs; yields (index, result), each job once, in the order in which they end.

    ``task`` goes to every worker once and stays there, so an object may build in its first call what it needs in all of
    them. An exception that it raises ends everything and is raised here, same type and message. A worker that dies
    (kill -9, no memory) has its job done again by another one. Whoever may leave the loop early closes the generator
    (``contextlib.closing``): that ends all workers, and what they were at is lost.

    Args:
        task: picklable and importable (a function or an object of a class at the top level of a module).
        jobs: picklable arguments of ``task``.
        executor: where; default the cores of this machine.
        workers: most jobs at a time. With 1 on this machine, they run in this process.
        retries: how often a job is done again whose worker died.
        threads: cores a job may use (its worker's OMP_NUM_THREADS).

    Raises:
        ValueError: at once, when the executor cannot work here or an argument is out of range.
        WorkerDied: a worker died more than ``retries`` times at the same job.
    """
    for name, value, least in (("workers", workers, 1), ("retries", retries, 0), ("threads", threads, 1)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    executor = LocalPool() if executor is None else executor
    executor.check()
    return _results(executor, task, jobs, min(workers, max(1, len(jobs))), retries, threads)


def _results(
    executor: Executor, task: Callable[[Job], Result], jobs: Sequence[Job], workers: int, retries: int, threads: int
) -> Generator[tuple[int, Result], None, None]:
    if not jobs:
        return
    outcomes = executor.outcomes(task, jobs, workers, retries, threads)
    try:
        for index, outcome in outcomes:
            yield index, result_of(outcome)
    finally:
        outcomes.close()


def executor_named(name: str, settings: Mapping[str, Any]) -> Executor:
    """The executor of a configuration.

    Args:
        name: one of ``EXECUTORS``.
        settings: of the group ``cluster``: ``address`` and ``gpus`` (Ray), ``slurm`` (fields of ``SlurmArray``).

    Raises:
        ValueError: when there is no such executor, or it cannot work here.
    """
    executor: Executor
    if name == "local":
        executor = LocalPool()
    elif name == "ray":
        executor = RayCluster(settings.get("address"), settings.get("gpus", 0))
    elif name == "slurm":
        slurm = dict(settings.get("slurm", {}))
        folder = Path(slurm.pop("folder", "outputs/slurm"))
        executor = SlurmArray(folder, gpus=settings.get("gpus", 0), **slurm)
    else:
        raise ValueError(f"executor must be one of {', '.join(EXECUTORS)}; got {name!r}")
    executor.check()
    return executor
