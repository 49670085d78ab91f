"""Failures among many jobs, counted: a worker that died is another matter than a task that raised."""

from __future__ import annotations

from collections import Counter


class WorkerDied(OSError):
    """The worker of one job died again and again.

    Args:
        job: index of the job.
        times: how often it was tried.
        finished, total: jobs.
        how: what is known of the last death, e.g. ``signal 9``.
    """

    def __init__(self, job: int, times: int, finished: int, total: int, how: str = "") -> None:
        self.job, self.times, self.finished, self.total, self.how = job, times, finished, total, how
        super().__init__(
            f"a worker process died (out of memory?{f' {how}' if how else ''}) {times} time{'s' * (times > 1)} at job "
            f"{job} after {finished} of {total} jobs; what is finished is kept, start again to go on"
        )


class Attempts:
    """Counts the deaths a job has caused.

    Args:
        retries: how often a job is tried again.
        total: number of jobs.
    """

    def __init__(self, retries: int, total: int) -> None:
        self.retries, self.total, self.finished = retries, total, 0
        self._deaths: Counter[int] = Counter()

    def died(self, job: int, how: str = "") -> None:
        """The worker of ``job`` died.

        Raises:
            WorkerDied: when the job may not be tried again.
        """
        self._deaths[job] += 1
        if self._deaths[job] > self.retries:
            raise WorkerDied(job, self._deaths[job], self.finished, self.total, how)
