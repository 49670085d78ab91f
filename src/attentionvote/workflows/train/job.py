"""Which training a configuration means, where it lives, and whether it can work: known before torch is imported."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from contextlib import AbstractContextManager
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.executors import executor_of
from attentionvote.command.identity import identity
from attentionvote.files import locked_folder, read_json
from attentionvote.part import Parts, only_part
from attentionvote.simulation.scene_spec import SceneSetSpec, scene_set_specs
from attentionvote.training.settings import check_isotropic
from attentionvote.workflows.train.beginning import MODEL, origin
from attentionvote.workflows.train.network import check_classes
from attentionvote.workflows.train.precision import CPU_PRECISION, resolved_precision
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.data.dataset_splits import DatasetSplits

log = logging.getLogger("attentionvote.train")
RUN, RESULT = "run.json", "result.json"
_MOST_EPOCHS = 10_000  # by which a training may be longer than the one it goes on from


@dataclass(frozen=True)
class TrainingJob:
    """One training.

    Attributes:
        directory: for its files.
        part: what it looks for, or a set of parts.
        specs: of the scene sets it needs, by split; empty with a dataset.
        dataset: whose scenes it takes instead.
        init_run: the run whose weights it begins with, where ``init`` means one.
        precision: of its arithmetic, resolved.
    """

    directory: Path
    part: Parts
    specs: dict[str, SceneSetSpec]
    dataset: DatasetSplits | None = None
    init_run: str | None = None
    precision: str = CPU_PRECISION

    @property
    def scene_counts(self) -> dict[str, int]:
        """Number of scenes by split."""
        if self.dataset is not None:
            return {split: len(scenes) for split, scenes in self.dataset.splits.items()}
        return {split: spec.scenes for split, spec in self.specs.items()}

    @property
    def run_id(self) -> str | None:
        """Of the MLflow run, once there is one."""
        run_id = (read_json(self.directory / RUN) or {}).get("run_id")
        return run_id if isinstance(run_id, str) else None

    @property
    def result(self) -> dict[str, Any] | None:
        """What the training ended with; None while it is not complete or when its model is gone."""
        result = read_json(self.directory / RESULT)
        if result is not None and not (self.directory / MODEL).is_file():
            log.warning("%s is gone: the training is completed again", self.directory / MODEL)
            return None
        return result

    def forget(self) -> None:
        """Remove everything this training has written so far; its MLflow run stays."""
        for path in self.directory.iterdir():
            if path.name != ".lock":
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def locked(self) -> AbstractContextManager[None]:
        """Be the only process of this training; FolderUnavailable when another one is at it."""
        return locked_folder(self.directory, str(self.directory.parents[1]), "training")


def find_training(cfg: TrainSettings, gpu: bool | None = None) -> TrainingJob:
    """The training of a configuration: new, interrupted or complete; the configuration's parts are checked together.

    Args:
        cfg: the configuration.
        gpu: whether the machine that trains has a GPU; None: it is this one.

    Raises:
        ValueError: with one sentence, when the parts of the configuration do not fit together.
        OSError: when the part's mesh is missing.
    """
    part: Parts = cfg.object()
    specs = scene_set_specs(part, cfg.simulation)
    check_classes(cfg.model.classes, part)
    check_isotropic(cfg.loss.settings, part)
    for split in ("train", "val", "test"):
        if split not in specs:
            raise ValueError(f"simulation.cycles must have train, val and test, got {', '.join(specs)}")
    precision = resolved_precision(cfg.trainer, gpu)
    job = TrainingJob(Path(cfg.outputs) / part.name, part, specs, precision=precision)
    if cfg.data.dataset is not None:
        job = replace(job, specs={}, dataset=_dataset(cfg, cfg.data.dataset, part))
    _check(cfg, job.scene_counts["train"])
    begins_with = {} if cfg.init is None else {"init": origin(cfg.init, cfg.tracking.store)}
    folder, folder_once = (
        job.directory / _digest({**identity(cfg, once=once), **begins_with}, job) for once in (False, True)
    )
    # A training of an earlier version is found where that put it.
    directory = folder if folder.exists() or not folder_once.exists() else folder_once
    return replace(job, directory=directory, init_run=begins_with.get("init", {}).get("run"))


def shorter_training(cfg: TrainSettings, job: TrainingJob) -> Path | None:
    """Folder of the complete training that is this one but for its fewer epochs, the longest; None where none is.

    Also None where this one has begun already, or begins with other weights.
    """
    begun = (job.directory / "checkpoints").exists()
    trained = {file.parent.name for file in job.directory.parent.glob(f"*/{RESULT}")}
    if begun or not trained or cfg.init is not None or cfg.trainer.max_steps is not None:
        return None
    for once in (False, True):
        plain = identity(cfg, once=once)
        for epochs in range(cfg.trainer.max_epochs - 1, max(0, cfg.trainer.max_epochs - _MOST_EPOCHS), -1):
            plain["trainer"]["max_epochs"] = epochs
            if (name := _digest(deepcopy(plain), job)) in trained:
                return job.directory.with_name(name)
    return None


def _digest(plain: dict[str, Any], job: TrainingJob) -> str:
    """What identifies a training: its settings, its part, the scenes of a dataset."""
    if job.precision != CPU_PRECISION:  # auto on a CPU keeps the digest it always had; on a GPU it is another training
        plain["trainer"]["precision"] = job.precision
    if len(job.part.parts) > 1:  # whether the number was also typed makes no other training
        plain["model"]["classes"] = len(job.part.parts)
    del plain["data"]["held_out"]  # what was trained without a dataset keeps its digest
    if job.dataset is None:
        del plain["data"]["dataset"]
    else:  # the scenes are the identity, wherever they lie
        del plain["simulation"]
        plain["data"]["dataset"] = {split: scenes.digest for split, scenes in job.dataset.splits.items()}
    return hashlib.sha256(json.dumps([plain, job.part.digest], sort_keys=True).encode()).hexdigest()[:12]


def _dataset(cfg: TrainSettings, folder: str, part: Parts) -> DatasetSplits:
    from attentionvote.data.dataset_split import check_sensor
    from attentionvote.data.dataset_splits import DatasetSplits

    check_sensor(cfg.data.sensor)
    only = only_part(part, "data.dataset")
    return DatasetSplits.open(Path(folder), only, asdict(cfg.data.held_out))


def _check(cfg: TrainSettings, scenes: int) -> None:
    from attentionvote.tracking.store import resolve_store

    resolve_store(cfg.tracking.store)
    executor_of(cfg)
    if cfg.trainer.batch_size > scenes:
        raise ValueError(
            f"trainer.batch_size must be at most the {scenes} training scenes, got {cfg.trainer.batch_size}"
        )
    steps = cfg.trainer.steps(scenes)
    if not cfg.trainer.dev_batches and cfg.trainer.schedule.vote_steps >= steps:
        raise ValueError(
            f"trainer.schedule.vote_steps must be less than the {steps} steps of the training, or no pose is ever "
            f"trained; got {cfg.trainer.schedule.vote_steps}"
        )
    if cfg.model.refinement is not None and cfg.model.refinement_steps:
        if not cfg.loss.weights.refined > 0:
            raise ValueError(
                "loss.weights.refined must be greater than 0 with model.refinement, got 0: set one of them"
            )
        if cfg.model.confidence != "quality":
            raise ValueError(
                "model.confidence must be quality with model.refinement, whose scores Eq. 10 does not train; got "
                f"{cfg.model.confidence}: set model.refinement=null"
            )
    most = max(cfg.trainer.peak_threshold, cfg.trainer.train_heat)
    if cfg.model.proposal_source == "fps" and most > 1:
        raise ValueError(
            "trainer.peak_threshold and trainer.train_heat must be at most 1 with model.proposal_source=fps, whose "
            f"proposals all have heat 1; got {most:g}"
        )
    if cfg.data.pool > cfg.data.density:
        raise ValueError(f"data.pool must be at most data.density ({cfg.data.density}), got {cfg.data.pool}")
    if cfg.data.points < cfg.model.centers[0]:
        raise ValueError(
            f"data.points must be at least model.centers[0] ({cfg.model.centers[0]}), got {cfg.data.points}"
        )
