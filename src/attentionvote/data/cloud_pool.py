"""Clouds of scenes, measured here, in several processes or on several machines.

Workers measure, whoever asks writes the rows: they lie in files that are mapped into memory, and pages that two
machines have mapped would overwrite each other's rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from attentionvote.data.dataset_split import DatasetSensing, DatasetSplit
from attentionvote.data.sensing import CloudSettings, measure, with_normals
from attentionvote.execution import Executor, WorkerDied, run_all
from attentionvote.part import Parts
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_set import SceneSet


@dataclass(frozen=True)
class CloudTask:
    """Measures a scene; a worker builds the ray caster for its first one."""

    part: Parts
    settings: CloudSettings

    def __call__(self, record: SceneRecord) -> Scene:
        """Its cloud."""
        return measure(record, self._caster, self.settings)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_caster"}

    @cached_property
    def _caster(self) -> PartCaster:
        return PartCaster(self.part)


@dataclass(frozen=True)
class DatasetCloudTask:
    """Measures a scene of a dataset by its name."""

    sensing: DatasetSensing
    settings: CloudSettings

    def __call__(self, name: str) -> Scene:
        """Its cloud."""
        return with_normals(*self.sensing(name), self.settings)


def jobs_of(
    scenes: SceneSet | DatasetSplit, part: Parts, settings: CloudSettings
) -> tuple[Sequence[Any], Callable[[Any], Scene]]:
    """What stands for each scene, and what measures it."""
    if isinstance(scenes, SceneSet):
        return scenes.records, CloudTask(part, settings)
    sensing = DatasetSensing(scenes.dataset, scenes.part, settings.sensor, settings.density)
    return scenes.names, DatasetCloudTask(sensing, settings)


def run_scenes(
    indices: Sequence[int],
    workers: int,
    scenes: Sequence[Any],
    task: Callable[[Any], Scene],
    executor: Executor | None = None,
) -> Iterator[tuple[int, Scene]]:
    """Measure these scenes; yields the index and the cloud of each as they come.

    Args:
        indices: of ``scenes``.
        workers: processes.
        scenes, task: see ``jobs_of``.
        executor: where the workers are; default this machine.

    Raises:
        OSError: when the worker of one scene died again and again.
    """
    jobs = [scenes[index] for index in indices]
    try:
        with closing(run_all(task, jobs, executor, workers=max(1, workers))) as results:
            for job, scene in results:
                yield indices[job], scene
    except WorkerDied as error:
        raise OSError(
            f"a worker process died while measuring clouds (out of memory? {error.how}) {error.times} times at scene "
            f"{indices[error.job]}; what is measured is kept, start again to go on"
        ) from error
