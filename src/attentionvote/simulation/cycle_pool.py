"""Runs the drop cycles of a scene set, in this process or in several, with a progress bar."""

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

from attentionvote.part import Part
from attentionvote.simulation.decomposition import Hulls
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_set import write_cycle
from attentionvote.simulation.scene_spec import SceneSetSpec

_job: tuple[Part, Hulls, PartCaster, SceneSetSpec, Path] | None = None  # of a worker process


def run_cycles(
    part: Part,
    hulls: Hulls,
    spec: SceneSetSpec,
    directory: Path,
    cycles: Sequence[int],
    workers: int,
    progress: bool,
    title: str,
    done: int = 0,
) -> None:
    """Simulate and store ``cycles``; ``done`` of the set were there before.

    Raises:
        OSError: when a worker process died.
    """
    if not cycles:
        return
    workers = min(workers, len(cycles))
    run = _in_this_process if workers == 1 else _in_processes
    scene_counts = run(part, hulls, spec, directory, cycles, workers)
    if not progress:
        for _ in scene_counts:
            pass
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("cycles, {task.fields[scenes]} new scenes"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=120) as bar:
        task = bar.add_task(title, total=done + len(cycles), completed=done, scenes=0)
        scenes = 0
        for count in scene_counts:
            scenes += count
            bar.update(task, advance=1, scenes=scenes)


def _in_this_process(
    part: Part, hulls: Hulls, spec: SceneSetSpec, directory: Path, cycles: Sequence[int], _workers: int
) -> Iterator[int]:
    caster = PartCaster(part)
    for cycle in cycles:
        yield write_cycle(part, hulls, caster, spec, directory, cycle)


def _in_processes(
    part: Part, hulls: Hulls, spec: SceneSetSpec, directory: Path, cycles: Sequence[int], workers: int
) -> Iterator[int]:
    before = multiprocessing.active_children()
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), _start_worker, (part, hulls, spec, directory)
    )
    futures: list[Future[int]] = []
    finished = False
    try:
        futures = [pool.submit(_work, cycle) for cycle in cycles]
        for future in as_completed(futures):
            yield future.result()
        finished = True
    except BrokenProcessPool as error:
        kept = sum(f.done() and not f.exception() for f in futures)
        raise OSError(
            f"a worker process died (out of memory?) after {kept} of {len(cycles)} cycles; they are kept, "
            "start again to go on"
        ) from error
    finally:
        if not finished:  # Ctrl-C or an error: what runs now is lost, what is stored stays
            for child in set(multiprocessing.active_children()) - set(before):
                child.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker(part: Part, hulls: Hulls, spec: SceneSetSpec, directory: Path) -> None:
    global _job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _job = (part, hulls, PartCaster(part), spec, directory)


def _die_with_parent() -> None:
    """End this worker when its parent is gone, also after kill -9."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _work(cycle: int) -> int:
    assert _job is not None
    return write_cycle(*_job, cycle)
