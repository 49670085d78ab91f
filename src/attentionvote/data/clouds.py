"""Point clouds of a scene set or of a dataset, measured once and kept on disk for all epochs.

Casting the rays and estimating the normals costs a few hundred milliseconds a scene, drawing a sample from the
stored cloud a few; so every scene is measured once with the sensor's noise, and a pool of its points is kept with
normals estimated on the whole (denser) cloud. A sample of an epoch is a random part of the pool.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.cloud_pool import jobs_of, run_scenes
from attentionvote.data.sensing import CloudSettings
from attentionvote.execution import Executor
from attentionvote.files import is_locked, remove_leftovers, waiting_lock, whole
from attentionvote.part import Parts
from attentionvote.scene import Scene
from attentionvote.simulation.scene_set import SceneSet

if TYPE_CHECKING:
    from attentionvote.data.dataset_split import DatasetSplit
    from attentionvote.datasets import GroundTruth
    from attentionvote.simulation.scene_record import SceneRecord

_SCENES_PER_PROCESS = 24


class Clouds:
    """The measured clouds of scenes; ``clouds[i]`` is scene i as a ``Scene`` with normals.

    Args:
        directory: where ``measure_clouds`` put them.
        scenes: the scene set they belong to, or the scenes of a dataset.
    """

    def __init__(self, directory: Path, scenes: SceneSet | DatasetSplit) -> None:
        self.directory = directory
        self.records: Sequence[SceneRecord | GroundTruth] = scenes.records
        self.cycle_of_scene = scenes.cycle_of_scene
        self._arrays = open_arrays(directory, "r")

    def __len__(self) -> int:
        return len(self.records)

    def count(self, index: int) -> int:
        """Number of points of scene ``index``."""
        return int(self._arrays["count"][index])

    def __getitem__(self, index: int) -> Scene:
        """Scene ``index``.

        Raises:
            ValueError: when its stored cloud is damaged.
        """
        record = self.records[index]
        count = self.count(index)
        try:
            return Scene(
                points=np.array(self._arrays["points"][index, :count]),
                normals=_unit(self._arrays["normals"][index, :count]),
                instance_ids=self._arrays["instance_ids"][index, :count].astype(np.int32),
                camera_from_part=record.camera_from_part,
                visible_fraction=record.visible_fraction,
                part_ids=record.part_ids,
            )
        except ValueError as error:
            raise ValueError(
                f"cloud {index} is damaged ({error}): delete the folder {self.directory} to measure it again"
            ) from error


def _unit(stored: NDArray[np.int8]) -> NDArray[np.float32]:
    """Normals ``(P, 3)`` as they were before they were stored, column by column: a third of the time of rows."""
    columns = [column.astype(np.float32) / np.float32(127) for column in stored.T]
    length = np.maximum(np.sqrt(sum(column * column for column in columns)), np.float32(1e-6))
    return np.stack([column / length for column in columns], axis=1)


def measure_clouds(
    scenes: SceneSet | DatasetSplit,
    part: Parts,
    settings: CloudSettings,
    root: Path,
    workers: int,
    progress: bool = True,
    executor: Executor | None = None,
) -> Clouds:
    """Measure what is missing of the clouds of scenes and open them.

    A scene's row is written before its mark, so that an interrupted call, also by kill -9, goes on where it was; a
    second process waits for the first.

    Args:
        scenes: the scene set, or the scenes of a dataset.
        part: its part, or set of parts.
        settings: sensor, density, pool.
        root: clouds are kept in ``root/<part>/<key>``.
        workers: processes; the result does not depend on it.
        progress: show a progress bar on stderr.
        executor: where the workers are; default this machine. Nor does the result depend on it.

    Raises:
        ValueError: when the stored clouds are damaged, or the executor cannot work here.
        FolderUnavailable: when something is missing and the directory cannot be written.
        OSError: when the worker of one scene died again and again, or the disk is full; what is measured is kept and
            the next call goes on from there.
    """
    directory = root / part.name / settings.key(scenes.digest)[:16]
    if _is_complete(directory):  # nothing is written, not even the lock: it may be a place for reading only
        return Clouds(directory, scenes)
    with waiting_lock(directory / ".lock"):
        create_arrays(directory, len(scenes), settings.pool)
        done = open_arrays(directory, "r")["done"]
        missing = [int(i) for i in np.flatnonzero(done == 0)]
        if missing:
            # A process needs seconds to start, a scene a fraction of one.
            workers = min(workers, len(missing) // _SCENES_PER_PROCESS)
            arrays, (jobs, task) = open_arrays(directory, "r+"), jobs_of(scenes, part, settings)
            measured: Iterable[tuple[int, Scene]] = run_scenes(missing, workers, jobs, task, executor)
            if progress:
                from rich.console import Console
                from rich.progress import track

                title = f"{part.name}: measuring clouds"
                measured = track(measured, title, len(missing), console=Console(stderr=True))
            for index, scene in measured:
                measure_into(arrays, index, scene)
    return Clouds(directory, scenes)


def _is_complete(directory: Path) -> bool:
    """Whether all clouds are there and nobody is at them; a row of another machine may come after its mark."""
    if not (directory / "count.npy").exists() or is_locked(directory):
        return False
    return bool(open_arrays(directory, "r")["done"].all())


def measure_into(arrays: dict[str, NDArray], index: int, scene: Scene) -> None:
    """Store scene ``index``; its mark comes last."""
    count = len(scene.points)
    assert scene.normals is not None
    arrays["points"][index, :count] = scene.points
    arrays["normals"][index, :count] = np.round(scene.normals * 127)
    arrays["instance_ids"][index, :count] = scene.instance_ids
    arrays["count"][index] = count
    arrays["done"][index] = 1


def create_arrays(directory: Path, scenes: int, pool: int) -> None:
    """Empty arrays for ``scenes`` clouds of at most ``pool`` points, unless they are there."""
    if (directory / "count.npy").exists():
        return
    shapes: dict[str, tuple[tuple[int, ...], type]] = {
        "points": ((scenes, pool, 3), np.float32),
        "normals": ((scenes, pool, 3), np.int8),
        "instance_ids": ((scenes, pool), np.int16),
        "done": ((scenes,), np.uint8),
        "count": ((scenes,), np.int32),  # last: its presence says that all are there
    }
    for name, (shape, dtype) in shapes.items():
        remove_leftovers(directory / f"{name}.npy")
        whole(directory / f"{name}.npy", partial(_empty_array, shape, dtype))


def _empty_array(shape: tuple[int, ...], dtype: type, path: Path) -> None:
    np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape).flush()
    # A sparse file would meet a full disk while it is written through the mapping, which kills the process.
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def open_arrays(directory: Path, mode: str) -> dict[str, NDArray]:
    """The arrays of a directory, mapped into memory.

    Raises:
        ValueError: when a file is missing or damaged.
    """
    arrays = {}
    for name in ("points", "normals", "instance_ids", "done", "count"):
        try:
            arrays[name] = np.load(directory / f"{name}.npy", mmap_mode=mode)  # type: ignore[arg-type]
        except (OSError, ValueError, EOFError) as error:
            raise ValueError(
                f"{directory / name}.npy must hold the {name} of measured clouds, but it is missing or damaged: "
                f"delete the folder {directory} to measure them again"
            ) from error
    return arrays
