"""Measures the clouds of a scene set in this process or in several."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from pathlib import Path

from numpy.typing import NDArray

from attentionvote.data.clouds import CloudSettings, measure, measure_into, open_arrays
from attentionvote.part import Part
from attentionvote.simulation import PartCaster, SceneRecord, SceneSet

_Job = tuple[dict[str, NDArray], Sequence[SceneRecord], PartCaster, CloudSettings]
_job: _Job | None = None  # of a worker process


def run_tasks(
    tasks: Sequence[Sequence[int]],
    workers: int,
    directory: Path,
    scenes: SceneSet,
    part: Part,
    settings: CloudSettings,
) -> Iterator[None]:
    """Measure the scenes of every task (indices) into the arrays of ``directory``; yields once a task.

    Raises:
        OSError: when a worker process died.
    """
    if workers <= 1:
        job = open_arrays(directory, "r+"), scenes.records, PartCaster(part), settings
        for task in tasks:
            _measure(job, task)
            yield None
        return
    before = multiprocessing.active_children()
    arguments = (directory, scenes, part, settings)
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker, arguments)
    futures: list[Future[None]] = []
    finished = False
    try:
        futures = [pool.submit(_work, task) for task in tasks]
        for future in as_completed(futures):
            yield future.result()
        finished = True
    except BrokenProcessPool as error:
        raise OSError(
            "a worker process died while measuring clouds (out of memory?); what is measured is kept, "
            "start again to go on"
        ) from error
    finally:
        if not finished:  # Ctrl-C or an error: a scene half written has no mark yet
            for child in set(multiprocessing.active_children()) - set(before):
                child.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _measure(job: _Job, task: Sequence[int]) -> None:
    arrays, records, caster, settings = job
    for index in task:
        measure_into(arrays, index, measure(records[index], caster, settings))


def _start_worker(directory: Path, scenes: SceneSet, part: Part, settings: CloudSettings) -> None:
    global _job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _job = open_arrays(directory, "r+"), scenes.records, PartCaster(part), settings


def _die_with_parent() -> None:
    """End this worker when its parent is gone, also after kill -9."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _work(task: Sequence[int]) -> None:
    assert _job is not None
    _measure(_job, task)
