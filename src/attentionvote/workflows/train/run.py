"""What ``make train`` does, step by step: the one place that knows configuration, data, training and tracking."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Any

import lightning as L
import torch

from attentionvote.command.executors import executor_of
from attentionvote.data.datamodule import PartDataModule
from attentionvote.execution.hardware import cores
from attentionvote.files import write_json
from attentionvote.simulation.resolution import log_resolution
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.training.checkpoint import usable_checkpoint
from attentionvote.training.checkpoint_writer import AtomicCheckpoints
from attentionvote.training.messages import plain_loader_errors, quiet_lightning
from attentionvote.training.pictures import ScenePictures
from attentionvote.training.progress import TrainingProgress
from attentionvote.workflows.train.beginning import checkpoint_of, take_over, take_weights
from attentionvote.workflows.train.data import prepare_data
from attentionvote.workflows.train.job import MODEL, RESULT, TrainingJob, shorter_training
from attentionvote.workflows.train.pieces import cloud_settings, data_module, pose_training
from attentionvote.workflows.train.precision import check_precision, device_type
from attentionvote.workflows.train.processes import FirstDoes, TrainingProcess
from attentionvote.workflows.train.results import SplitDetections, assess, best_score, detect_everything, log_losses
from attentionvote.workflows.train.settings import TrainSettings
from attentionvote.workflows.train.tracking import description, open_tracking
from attentionvote.workflows.train.trainer import lightning_trainer, made

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
        check_precision(cfg.trainer.precision, job.precision, device_type(cfg.trainer.accelerator))
        L.seed_everything(cfg.seed, verbose=False)
        # Half of the cores: the others as often as not are the same cores' second halves, and a loader wants one.
        self.threads = cfg.trainer.threads or max(1, process.cores // 2)
        torch.set_num_threads(self.threads)
        self.clouds, self.module = cloud_settings(cfg), pose_training(cfg, job.part)
        self.workers = cfg.workers or cores()
        self.progress, self.pictures, self.checkpoint_files = TrainingProgress(), ScenePictures(), AtomicCheckpoints()
        with quiet_lightning():
            self.trainer = lightning_trainer(cfg, job, process, [self.progress, self.pictures], self.checkpoint_files)
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
            on_gpu = self.trainer.strategy.root_device.type == "cuda"
            data = data_module(
                self.cfg, self.module, clouds["train"], clouds["val"], clouds["test"], self.process, on_gpu=on_gpu
            )
            if self.process.rank:
                self._fit(data, None)
                if not self.cfg.trainer.dev_batches:
                    self._detect(data)
                return None
            if self.cfg.trainer.dev_batches:
                return self._tried(self._fit(data, None))
            with open_tracking(self.cfg, self.job, self.module, self.process.processes) as tracked:
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
                tracked.describe(description(self.job, self.module, result))
                write_json(self.job.directory / RESULT, result)
        log.info(
            "AP %s at 10/5/2 %% D; see the run with `make ui`",
            "/".join(f"{assessed['metrics'][f'ap_{k}']:.3f}" for k in (10, 5, 2)),
        )
        return result

    def _tried(self, progress: TrainingProgress) -> dict[str, Any]:
        """What ``fast_dev_run`` ends with."""
        return {
            "stage": "train",
            "object": self.part.name,
            "fast_dev_run": self.cfg.trainer.dev_batches,
            "steps": self.trainer.global_step,
            "train_seconds": round(progress.seconds, 1),
        }

    @property
    def _checkpoints(self) -> Path:
        return self.job.directory / "checkpoints"

    def _introduce(self) -> None:
        """One line on what is chosen."""
        counts = self.job.scene_counts
        if self.job.dataset is not None:
            log.info("scenes of %s: %s", self.job.dataset.folder, self.job.dataset)
        else:
            sensor, density = self.cfg.data.sensor, self.cfg.data.density
            log_resolution(log, self.part, self.cfg.simulation, sensor, density)
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

    def _fit(self, data: PartDataModule, tracked: Any | None) -> TrainingProgress:
        """Train to the end, from wherever an earlier call came to; only the first process tracks."""
        trainer = self.trainer
        if tracked is not None:
            self._track(tracked)
        shapes = {name: value.shape for name, value in self.module.state_dict().items()}
        files = [self._checkpoints / "last.ckpt", self._checkpoints / "best.ckpt"]
        start = self.first_does("checkpoint", lambda: self._begin(files, shapes))
        if not start and self.cfg.init is not None:
            store, folder = self.cfg.tracking.store, self.job.directory / "init"
            init, run_id = self.cfg.init, self.job.init_run
            path = self.first_does("init", lambda: str(checkpoint_of(init, run_id, store, folder)))
            take_weights(self.module.model, Path(path), self.cfg.init)
        trainer.fit(self.module, data, ckpt_path=start or None, weights_only=True)
        if trainer.interrupted:
            raise KeyboardInterrupt
        return self.progress

    def _begin(self, files: list[Path], shapes: dict[str, torch.Size]) -> str:
        """The checkpoint to go on from, empty at the beginning; of a shorter training where there is one."""
        if self.cfg.trainer.dev_batches:
            return ""
        anew = self.cfg.resume == "never" or self.cfg.force
        shorter = None if anew else shorter_training(self.cfg, self.job)
        if shorter is not None:
            if self.cfg.goes_on_exactly:
                take_over(shorter, self.job.directory)
            else:
                log.info(
                    "trained anew, because the learning rate and callbacks of %s went by its own number of epochs; "
                    "init=%s would begin with its weights", shorter, shorter,
                )  # fmt: skip
        return str(usable_checkpoint(files, shapes) or "")

    def _track(self, tracked: Any) -> None:
        """Metrics, checkpoints and pictures go to the run."""
        from attentionvote.drawing.scene_pictures import scene_picture
        from attentionvote.tracking.lightning_logger import RunLogger

        def draw(scene: int, step: int, inputs: dict[str, Any]) -> None:
            title = f"{self.part.name}, validation scene {scene}, step {step}"
            tracked.log_figure(f"val/scene_{scene}.png", scene_picture(**inputs, title=title), step)

        self.pictures.draw = draw
        self.checkpoint_files.before_save = tracked.flush_metrics
        more = [made(f"loggers.{name}", logger) for name, logger in self.cfg.loggers.items()]
        self.trainer.loggers = [RunLogger(tracked), *more]

    def _detect(self, data: PartDataModule) -> tuple[Path, dict[str, SplitDetections]]:
        """The checkpoint that the training ends with, and what it finds (in the first process, of all)."""
        files = [self._checkpoints / "best.ckpt", self._checkpoints / "last.ckpt"]
        weights = Path(self.first_does("weights", lambda: str(next(path for path in files if path.is_file()))))
        return weights, detect_everything(self.module, data, weights, self.trainer.strategy.root_device)
