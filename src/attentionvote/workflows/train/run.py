"""What ``make train`` does, step by step: the one place that knows configuration, data, training and tracking."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from attentionvote import __version__
from attentionvote.command.executors import executor_of
from attentionvote.data.clouds import Clouds
from attentionvote.data.datamodule import PartDataModule
from attentionvote.data.sensing import CloudSettings
from attentionvote.execution.hardware import cores
from attentionvote.files import write_json
from attentionvote.model.network import AttentionVote
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.training.checkpoint import FORMAT, usable_checkpoint
from attentionvote.training.checkpoint_writer import AtomicCheckpoints
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.messages import plain_loader_errors, quiet_lightning
from attentionvote.training.module import PoseTraining
from attentionvote.training.pictures import ScenePictures
from attentionvote.training.progress import TrainingProgress
from attentionvote.training.synced_norm import RowNormSync
from attentionvote.training.termination import PlainTermination
from attentionvote.workflows.sweep.trial_report import trial_callbacks
from attentionvote.workflows.train.data import prepare_data
from attentionvote.workflows.train.job import MODEL, RESULT, TrainingJob
from attentionvote.workflows.train.network import described, network_arguments
from attentionvote.workflows.train.processes import FirstDoes, TrainingProcess
from attentionvote.workflows.train.results import SplitDetections, assess, best_score, detect_everything, log_losses
from attentionvote.workflows.train.settings import TrainSettings
from attentionvote.workflows.train.tracking import open_tracking

log = logging.getLogger("attentionvote.train")


class TrainingRun:
    """One training from data to tested model, in this process or in this one among several.

    Args:
        place: this process among those of the training.
        first_does: lets the first one work while the others wait.

    Raises:
        ValueError: with one sentence, when a setting of model, loss, data or trainer is impossible.
    """

    def __init__(self, cfg: TrainSettings, job: TrainingJob, process: TrainingProcess, first_does: FirstDoes) -> None:
        self.cfg, self.job, self.part = cfg, job, job.part
        self.process, self.first_does = process, first_does
        part, t = job.part, cfg.trainer
        L.seed_everything(cfg.seed, verbose=False)
        self.threads = t.threads or process.cores
        torch.set_num_threads(self.threads)
        arguments = network_arguments(cfg.model, part)
        model = AttentionVote.from_arguments(arguments)
        loss = AttentionVoteLoss(part, asdict(cfg.loss.weights), cfg.loss.settings)
        self.clouds = CloudSettings(cfg.data.sensor, cfg.data.density, cfg.data.pool, cfg.data.normal_neighbors)
        metadata = {
            "format": FORMAT,
            "version": __version__,
            "model": arguments,
            **described(part),
            "points": cfg.data.points,
            "clouds": asdict(self.clouds),
            "peak_threshold": t.peak_threshold,
            "confidence_threshold": None,
            "data": {},
            "test": {},
        }
        self.module = PoseTraining(
            model,
            loss,
            part,
            t.schedule,
            t.optimizer,
            t.learning_rate,
            t.weight_decay,
            t.peak_threshold,
            t.train_heat,
            json.loads(json.dumps(metadata)),  # plain values only: what torch.load(weights_only=True) accepts
        )
        self.augmentation = cfg.data.augmentation
        self.workers = cfg.workers or cores()
        with quiet_lightning():
            self.trainer = self._trainer()
        # Lightning itself does so only after the average of the weights was set up and a checkpoint was loaded.
        self.trainer.precision_plugin.convert_module(self.module)

    def run(self) -> dict[str, Any] | None:
        """Everything; the dictionary of the JSON line, None where the first process prints it."""
        start = time.monotonic()
        self._introduce()
        if not self.process.rank:
            connect(resolve_store(self.cfg.tracking.store))  # said before the scenes are made, not after
        clouds, digests = prepare_data(
            self.job, self.clouds, self.cfg.root, executor_of(self.cfg), self.workers, self.process, self.first_does
        )
        self.module.metadata["data"] |= digests
        if self.job.dataset is not None:
            self.module.metadata["data"] |= self.job.dataset.evidence
            self.module.metadata["dataset"] = self.job.dataset.described()
        data_seconds = time.monotonic() - start
        with plain_loader_errors(), quiet_lightning():
            data = self._data_module(clouds)
            if self.process.rank:
                self._fit(data, None)
                self._detect(data)
                return None
            with open_tracking(
                self.job, self.module, self._choices(), self.process.processes, self.cfg.tracking, self.cfg.yaml()
            ) as tracked:
                progress = self._fit(data, tracked)
                losses = log_losses(tracked)
                weights, detections = self._detect(data)
                model_file, step = self.job.directory / MODEL, self.trainer.global_step
                assessed = assess(self.module, data, detections, model_file, tracked, step)
                result = {
                    "stage": "train",
                    "object": self.part.name,
                    "run_id": tracked.id,
                    "model": str(model_file),
                    "checkpoint": str(weights),
                    "val_ap": best_score(self.trainer),
                    **assessed,
                    "losses": losses,
                    "steps": step,
                    "data_seconds": round(data_seconds, 1),
                    "train_seconds": round(progress.seconds, 1),
                    "seconds": round(time.monotonic() - start, 1),
                    "commit": tracked.commit,
                }
                tracked.log_text("result.json", json.dumps(result, indent=2))
                write_json(self.job.directory / RESULT, result)
        log.info(
            "AP %s at 10/5/2 %% D; see the run with `make ui`",
            "/".join(f"{assessed['metrics'][f'ap_{k}']:.3f}" for k in (10, 5, 2)),
        )
        return result

    def _choices(self) -> dict[str, object]:
        """What tells trainings apart at a glance: parameters of the run."""
        cfg = self.cfg
        choices: dict[str, object] = {
            "object": self.part.name,
            "diameter": self.part.diameter,
            "seed": cfg.seed,
            "points": cfg.data.points,
            "parameters": sum(p.numel() for p in self.module.model.parameters()),
            "train_scenes": self.job.scene_counts["train"],
            "epochs": cfg.trainer.max_epochs,
            "batch_size": cfg.trainer.batch_size,
            "learning_rate": cfg.trainer.learning_rate,
        }
        return choices if self.job.dataset is None else choices | {"dataset": str(self.job.dataset)}

    @property
    def _checkpoints(self) -> Path:
        return self.job.directory / "checkpoints"

    def _introduce(self) -> None:
        """One line on what is chosen."""
        counts = self.job.scene_counts
        if self.job.dataset is not None:
            log.info("scenes of %s: %s", self.job.dataset.folder, self.job.dataset)
        log.info(
            "%s: %d/%d/%d scenes (train/val/test), %d points, %s parameters, %d epochs of batches of %d "
            "on %s (%s, %d thread%s%s)%s",
            self.part.name, counts["train"], counts["val"], counts["test"], self.cfg.data.points,
            f"{sum(p.numel() for p in self.module.parameters()):,}", self.cfg.trainer.max_epochs,
            self.cfg.trainer.batch_size, self.trainer.strategy.root_device, self.trainer.precision, self.threads,
            "s" * (self.threads > 1),
            f" in each of {self.process.processes} processes" if self.process.processes > 1 else "",
            ", going on after an interruption" if self.job.run_id else "",
        )  # fmt: skip

    def _data_module(self, clouds: dict[str, Clouds]) -> PartDataModule:
        cfg = self.cfg
        return PartDataModule(
            clouds["train"],
            clouds["val"],
            clouds["test"],
            cfg.data.points,
            self.module.model.layout,
            cfg.trainer.batch_size,
            cfg.data.workers,
            self.augmentation,
            cfg.seed,
            self.process.rank,
            self.process.processes,
        )

    def _trainer(self) -> L.Trainer:
        t, folder = self.cfg.trainer, self._checkpoints
        best = ModelCheckpoint(folder, "best", monitor="val/ap", mode="max", enable_version_counter=False)
        last = ModelCheckpoint(folder, "last", enable_version_counter=False, save_on_train_epoch_end=True)
        self.progress = TrainingProgress()
        self.pictures = ScenePictures()
        self.checkpoint_files = AtomicCheckpoints()
        callbacks: list[Callback] = [best, last, self.progress, self.pictures]
        callbacks += trial_callbacks()
        if t.average_decay:
            callbacks.append(EMAWeightAveraging(decay=t.average_decay, use_buffers=True))
        if self.process.processes > 1:
            callbacks.append(PlainTermination())
        try:
            return self._lightning_trainer(callbacks)
        except (MisconfigurationException, RuntimeError) as error:  # no such device, say
            raise ValueError(f"trainer settings cannot be met: {error}") from error

    def _lightning_trainer(self, callbacks: list[Callback]) -> L.Trainer:
        t = self.cfg.trainer
        return L.Trainer(
            accelerator=t.accelerator,
            **self.process.trainer_arguments(),
            precision=self._precision(),
            max_epochs=t.max_epochs,
            gradient_clip_val=t.gradient_clip,
            check_val_every_n_epoch=t.validate_every,
            log_every_n_steps=t.log_every_steps,
            num_sanity_val_steps=0,
            logger=False,
            callbacks=callbacks,
            plugins=[self.checkpoint_files, *([RowNormSync()] if self.process.processes > 1 else [])],
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=self.job.directory,
        )

    def _fit(self, data: PartDataModule, tracked: Any | None) -> TrainingProgress:
        """Train to the end, from wherever an earlier call came to; only the first process tracks."""
        trainer = self.trainer
        if tracked is not None:
            self._track(tracked)
        shapes = {name: value.shape for name, value in self.module.state_dict().items()}
        files = [self._checkpoints / "last.ckpt", self._checkpoints / "best.ckpt"]
        start = self.first_does("checkpoint", lambda: str(usable_checkpoint(files, shapes) or ""))
        trainer.fit(self.module, data, ckpt_path=start or None, weights_only=True)
        if trainer.interrupted:
            raise KeyboardInterrupt
        return self.progress

    def _track(self, tracked: Any) -> None:
        """Metrics, checkpoints and pictures go to the run."""
        from attentionvote.drawing.scene_pictures import scene_picture
        from attentionvote.tracking.lightning_logger import RunLogger

        def draw(scene: int, step: int, inputs: dict[str, Any]) -> None:
            title = f"{self.part.name}, validation scene {scene}, step {step}"
            tracked.log_figure(f"val/scene_{scene}.png", scene_picture(**inputs, title=title), step)

        self.pictures.draw = draw
        self.checkpoint_files.before_save = tracked.flush_metrics
        self.trainer.loggers = [RunLogger(tracked)]

    def _detect(self, data: PartDataModule) -> tuple[Path, dict[str, SplitDetections]]:
        """The checkpoint that the training ends with, and what it finds (in the first process, of all)."""
        files = [self._checkpoints / "best.ckpt", self._checkpoints / "last.ckpt"]
        weights = Path(self.first_does("weights", lambda: str(next(path for path in files if path.is_file()))))
        return weights, detect_everything(self.module, data, weights, self.trainer.strategy.root_device)

    def _precision(self) -> Any:
        if self.cfg.trainer.precision != "auto":
            return self.cfg.trainer.precision
        return "bf16-mixed" if torch.cuda.is_available() and torch.cuda.is_bf16_supported() else "32-true"
