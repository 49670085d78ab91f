"""Jobs in processes of this machine; a process that dies takes one job with it, and another process does it again."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Any

from attentionvote.execution.failures import Attempts
from attentionvote.execution.outcome import inherited, perform, worker_environment

_END_S = 5.0  # what a worker gets to end by itself


@dataclass(frozen=True)
class LocalPool:
    """The cores of this machine."""

    def check(self) -> None:
        """Always works."""

    def outcomes(
        self, task: Callable[[Any], Any], jobs: Sequence[Any], workers: int, retries: int, threads: int
    ) -> Generator[tuple[int, bytes], None, None]:
        """See ``Executor``; one worker is this process, which is quicker and cannot survive its own death."""
        if workers == 1:
            for index, job in enumerate(jobs):
                yield index, perform_here(task, job)
            return
        pool = _Pool(pickle.dumps(task), jobs, workers, Attempts(retries, len(jobs)), threads)
        try:
            yield from pool.run()
        finally:
            pool.end()


def perform_here(task: Callable[[Any], Any], job: Any) -> bytes:
    """Do a job in this process: what it raises is raised, Ctrl-C included, with its own traceback."""
    return pickle.dumps((True, task(job)))


class _Worker:
    """One process, the job it is at (None: none yet), and the line to it."""

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.line, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs,), daemon=False)
        with inherited({k: v for k, v in worker_environment(threads).items() if k != "PYTHONPATH"}):
            self.process.start()
        theirs.close()
        self.job: int | None = None
        self.ready = False

    def receive(self) -> bytes | None:
        """What the worker has said; None when it is dead and has said nothing before."""
        try:
            return self.line.recv_bytes() if self.line.poll() else None
        except (EOFError, OSError):
            return None


class _Pool:
    def __init__(self, task: bytes, jobs: Sequence[Any], workers: int, attempts: Attempts, threads: int) -> None:
        self.task, self.jobs, self.attempts, self.threads = task, jobs, attempts, threads
        self.waiting = deque(range(len(jobs)))
        self.workers: list[_Worker] = []
        self.leaving: list[_Worker] = []
        self.wanted = workers
        # Also when the program ends while somebody holds the generator: multiprocessing would wait for its children.
        self._at_exit = Finalize(self, _end_all, (self.workers, self.leaving), exitpriority=10)

    def run(self) -> Generator[tuple[int, bytes], None, None]:
        """Index and outcome of every job."""
        busy = len(self.jobs)
        while busy:
            while len(self.workers) < min(self.wanted, busy):
                self.workers.append(_Worker(self.threads))
            lines = {worker.line: worker for worker in self.workers}
            ends = {worker.process.sentinel: worker for worker in self.workers}
            for event in wait([*lines, *ends]):
                worker = lines[event] if isinstance(event, Connection) else ends[event]  # type: ignore[index]
                if worker not in self.workers:
                    continue  # its line and its end came together
                message = worker.receive()
                if message is None:
                    self._bury(worker)
                    continue
                index = worker.job
                if worker.ready and index is not None:
                    busy -= 1
                    self.attempts.finished += 1
                self._employ(worker)
                if index is not None:
                    yield index, message

    def _employ(self, worker: _Worker) -> None:
        """Give the worker the next job, or let it go."""
        worker.job = None  # the last one is done
        try:
            if not worker.ready:
                worker.line.send_bytes(self.task)
                worker.ready = True
            if not self.waiting:
                self.workers.remove(worker)
                worker.line.close()  # it ends when it reads the end of the line
                self.leaving.append(worker)
            else:
                worker.line.send_bytes(pickle.dumps(self.jobs[self.waiting[0]]))
                worker.job = self.waiting.popleft()  # one that died while idle was not at it
        except (BrokenPipeError, ConnectionResetError):
            pass  # it died this moment: its end is the next event

    def _bury(self, worker: _Worker) -> None:
        """A worker is dead: its job comes first again."""
        self.workers.remove(worker)
        worker.process.join()
        worker.line.close()
        job = worker.job if worker.job is not None else (self.waiting[0] if self.waiting else None)
        if worker.job is not None:
            self.waiting.appendleft(worker.job)
        code = worker.process.exitcode
        if job is not None:  # one that dies before it has a job counts for the next: it could go on for ever
            self.attempts.died(job, f"signal {-code}" if code is not None and code < 0 else f"exit code {code}")

    def end(self) -> None:
        """End every worker that is left."""
        self._at_exit()


def _serve(line: Connection) -> None:
    """A worker's life: the task, then job after job until the line ends."""
    # Ctrl-C reaches the whole group; the parent decides. A handler, because children would inherit SIG_IGN.
    signal.signal(signal.SIGINT, lambda *_: None)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    try:
        line.send_bytes(b"ready")
        task = cache(partial(pickle.loads, line.recv_bytes()))
        while True:
            line.send_bytes(perform(task, line.recv_bytes()))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _end_all(workers: list[_Worker], leaving: list[_Worker]) -> None:
    _end(workers)
    _end(leaving)


def _end(workers: list[_Worker]) -> None:
    """End these workers; those whose line is closed end by themselves."""
    for worker in workers:
        if not worker.line.closed:
            worker.process.terminate()
            worker.line.close()
    for worker in workers:
        worker.process.join(_END_S)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
    workers.clear()


def _die_with_parent() -> None:
    """End this worker when its parent is gone, also after kill -9."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
