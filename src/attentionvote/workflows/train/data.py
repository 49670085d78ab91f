"""The measured clouds that a training needs: made by its first process, found by the others."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.dataset_split import DatasetSplit
from attentionvote.data.sensing import CloudSettings
from attentionvote.execution import Executor
from attentionvote.simulation.scene_set import SceneSet, generate_scene_set
from attentionvote.simulation.scene_spec import scene_set_directory
from attentionvote.workflows.train.job import TrainingJob
from attentionvote.workflows.train.processes import FirstDoes, TrainingProcess

_CYCLES_PER_PROCESS = 5


def prepare_data(
    job: TrainingJob,
    settings: CloudSettings,
    root: str,
    executor: Executor,
    workers: int,
    process: TrainingProcess,
    first_does: FirstDoes,
) -> tuple[dict[str, Clouds], dict[str, str]]:
    """Generate and measure what is missing, or measure a dataset, in the first process; open it in all.

    Args:
        job: the training.
        settings: of the clouds.
        root: folder of scene sets and clouds, shared by all processes.
        executor, workers: where the work is done, and by how many processes.
        process: this one.
        first_does: lets the first one work while the others wait.

    Returns:
        clouds and digests of the scenes, by split.

    Raises:
        ValueError: when a process does not see what the first one has made.
    """
    made: dict[str, tuple[Clouds, SceneSet | DatasetSplit, Path]] = {}

    def make() -> dict[str, Any]:
        for split, read in (job.dataset.splits if job.dataset else {}).items():
            clouds = measure_clouds(read, job.part, settings, Path(root) / "clouds", workers, executor=executor)
            made[split] = clouds, read, read.dataset.directory
        for split, spec in job.specs.items():
            directory = scene_set_directory(Path(root) / "scenes", job.part.name, spec)
            # A process needs seconds to start, about as long as a cycle takes.
            few = max(1, min(workers, spec.cycles // _CYCLES_PER_PROCESS))
            scenes = generate_scene_set(job.part, spec, directory, few, executor=executor)
            clouds = measure_clouds(scenes, job.part, settings, Path(root) / "clouds", workers, executor=executor)
            made[split] = clouds, scenes, directory
        return {split: [str(d), str(c.directory), s.digest] for split, (c, s, d) in made.items()}

    locations = first_does("data", make)
    digests = {split: digest for split, (*_, digest) in locations.items()}
    if made:
        return {split: clouds for split, (clouds, *_) in made.items()}, digests
    read_here = job.dataset.splits if job.dataset else {}
    return {split: _open(root, process, read_here.get(split), *where) for split, where in locations.items()}, digests


def _open(
    root: str, process: TrainingProcess, read_here: DatasetSplit | None, scenes: str, clouds: str, digest: str
) -> Clouds:
    unseen = [path for path in (scenes, clouds) if not Path(path).is_dir()]
    if unseen:
        raise ValueError(
            f"root={root} must be a folder that all processes share, but {process.name} on {socket.gethostname()} "
            f"does not find {unseen[0]}"
        )
    opened = read_here or SceneSet.open(Path(scenes))
    if opened.digest != digest:
        shared = f"root={root} and the dataset" if read_here else f"root={root}"
        raise ValueError(
            f"{scenes} must hold the same scenes for all processes, but {process.name} on {socket.gethostname()} finds "
            f"{opened.digest[:12]} instead of {digest[:12]}: share {shared}"
        )
    return Clouds(Path(clouds), opened)
