"""Jobs as tasks of a Ray cluster: an existing one, or one of this machine for the length of the call."""

from __future__ import annotations

import importlib.util
import os
import pickle
import socket
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from attentionvote.execution.failures import Attempts
from attentionvote.execution.outcome import perform, worker_environment

_OBJECT_STORE = 512 * 2**20  # bytes, of a cluster of this machine: results wait here for a moment only
_NO_GPU = {"RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "1"}  # else Ray leaves a job that takes none all of them
_held: tuple[str, Callable[[Any], Any]] | None = None  # of a worker process: a call's token and its task


@dataclass(frozen=True)
class RayCluster:
    """A Ray cluster.

    Args:
        address: ``auto`` joins the cluster of this machine, ``host:6379`` another one; None starts one here for the
            length of the call. A program that has called ``ray.init`` itself keeps its own.
        gpus: GPUs a job takes; Ray hides all of them from a job that takes none.
    """

    address: str | None = None
    gpus: float = 0

    def check(self) -> None:
        """Whether Ray is installed.

        Raises:
            ValueError: when it is not.
        """
        if importlib.util.find_spec("ray") is None:
            raise ValueError(
                "executor=ray needs the package ray, which is not installed: install the extra cluster "
                "(pip install '.[cluster]'), or choose executor=local"
            )

    @contextmanager
    def shared(self, cores: int) -> Iterator[RayCluster]:
        """One cluster for many calls, those of child processes too: itself, or one of this machine for the block.

        Args:
            cores: of a cluster that is started here.

        Raises:
            ConnectionError: when it cannot be started.
        """
        if self.address is not None:
            yield self
            return
        with self._joined(cores) as ray:
            yield replace(self, address=ray.get_runtime_context().gcs_address)

    def outcomes(
        self, task: Callable[[Any], Any], jobs: Sequence[Any], workers: int, retries: int, threads: int
    ) -> Generator[tuple[int, bytes], None, None]:
        """See ``Executor``.

        Raises:
            ConnectionError: when there is no cluster at ``address``.
            ValueError: when no machine of it can take a job.
        """
        with self._joined(workers * threads) as ray:
            self._check_room(ray, threads)
            yield from self._run(ray, task, jobs, workers, Attempts(retries, len(jobs)), threads)

    @contextmanager
    def _joined(self, cores: int) -> Iterator[Any]:
        """The module ray, in a cluster while the block runs."""
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        import ray

        ours = not ray.is_initialized()
        if ours:
            self._join(ray, cores)
        try:
            yield ray
        finally:
            if ours:
                ray.shutdown()

    def _join(self, ray: Any, cores: int) -> None:
        started = {} if self.address else {"num_cpus": cores, "include_dashboard": False}
        started |= {} if self.address else {"object_store_memory": _OBJECT_STORE}
        try:
            ray.init(address=self.address or "local", log_to_driver=False, logging_level="error", **started)
        except Exception as error:  # Ray's own too, of a node that takes too long to start
            first = str(error).strip().partition("\n")[0]
            raise ConnectionError(
                f"the Ray cluster at address={self.address or 'null'} cannot be joined ({first}): start one with "
                "`ray start --head`, or set cluster.address=null for one of this machine"
            ) from error

    def _check_room(self, ray: Any, threads: int) -> None:
        """Ray would wait for ever for a machine that is large enough."""
        machines = [machine["Resources"] for machine in ray.nodes() if machine["Alive"]]
        if not any(m.get("CPU", 0) >= threads and m.get("GPU", 0) >= self.gpus for m in machines):
            have = "; ".join(f"{m.get('CPU', 0):g} cores and {m.get('GPU', 0):g} GPUs" for m in machines)
            raise ValueError(
                f"a machine of the Ray cluster must have {threads} cores and {self.gpus:g} GPUs for a job, but they "
                f"have {have}: lower threads or cluster.gpus"
            )

    def _run(
        self,
        ray: Any,
        task: Callable[[Any], Any],
        jobs: Sequence[Any],
        workers: int,
        attempts: Attempts,
        threads: int,
    ) -> Generator[tuple[int, bytes], None, None]:
        remote = ray.remote(_perform).options(
            num_cpus=threads,
            num_gpus=self.gpus,
            max_retries=0,  # counted here, as everywhere
            runtime_env={"env_vars": worker_environment(threads) | ({} if self.gpus else _NO_GPU)},
        )
        token, stored = uuid.uuid4().hex, ray.put(pickle.dumps(task))
        waiting = list(reversed(range(len(jobs))))
        running: dict[Any, int] = {}
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    index = waiting.pop()
                    running[remote.remote(token, [stored], os.getcwd(), pickle.dumps(jobs[index]))] = index
                for reference in ray.wait(list(running), num_returns=1)[0]:
                    index = running.pop(reference)
                    try:
                        outcome = ray.get(reference)
                    except ray.exceptions.RayError as error:  # not the task's: that is an outcome
                        attempts.died(index, type(error).__name__)
                        waiting.append(index)
                        continue
                    attempts.finished += 1
                    yield index, outcome
        finally:
            for reference in running:
                with suppress(ray.exceptions.RayError):
                    ray.cancel(reference, force=True)


def _perform(token: str, stored: list[Any], folder: str, job: bytes) -> bytes:
    """One job in a worker of the cluster, in the driver's working directory."""
    return perform(partial(_task, token, stored, folder), job)


def _task(token: str, stored: list[Any], folder: str) -> Callable[[Any], Any]:
    """The task of a call, fetched once a worker process."""
    global _held
    if _held is None or _held[0] != token:
        import ray

        if not Path(folder).is_dir():
            raise FileNotFoundError(
                f"the Ray worker on {socket.gethostname()} has no folder {folder}: the machines of a cluster "
                "must share the file system under the same path (docs/scaling.md)"
            )
        os.chdir(folder)
        _held = token, pickle.loads(ray.get(stored[0]))
    return _held[1]
