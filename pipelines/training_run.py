"""What ``make train`` does, step by step; the only place that knows configuration, data, training and tracking at once."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint
from omegaconf import DictConfig, OmegaConf

from attentionvote.data import Augmentation, Clouds, CloudSettings, measure_clouds
from attentionvote.data.datamodule import PartDataModule
from attentionvote.evaluation import curves, evaluate
from attentionvote.model import AttentionVote
from attentionvote.part import Part
from attentionvote.simulation import Sensor, generate_scene_set, scene_set_directory, scene_set_specs
from attentionvote.training import AttentionVoteLoss, LossSettings, PoseTraining, Schedule
from attentionvote.training.operating_point import best_threshold, confident
from attentionvote.training.pictures import picture_inputs
from attentionvote.training.progress import TrainingProgress

log = logging.getLogger("attentionvote.train")
# What may change between two calls that mean the same training.
_NOT_IDENTITY = ("resume", "force", "workers", "tracking", "outputs", "root")


@dataclass(frozen=True)
class Training:
    """Where one training lives: ``directory`` for its files, ``run_id`` and ``result`` once known."""

    directory: Path
    run_id: str | None
    result: dict[str, Any] | None


def build_part(cfg: DictConfig) -> Part:
    """The part of a configuration."""
    part: Part = instantiate(cfg.object)
    return part


def find_training(cfg: DictConfig, part: Part) -> Training:
    """The training of this configuration and part: new, interrupted or complete."""
    plain = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)
    identity = {key: value for key, value in plain.items() if key not in _NOT_IDENTITY}
    digest = hashlib.sha256(json.dumps([identity, part.digest], sort_keys=True).encode()).hexdigest()
    directory = Path(cfg.outputs) / part.name / digest[:12]
    if (cfg.force or cfg.resume == "never") and directory.exists():
        shutil.rmtree(directory)
    run_file, result_file = directory / "run.json", directory / "result.json"
    run_id = json.loads(run_file.read_text())["run_id"] if run_file.exists() else None
    result = json.loads(result_file.read_text()) if result_file.exists() else None
    return Training(directory, run_id, result)


class TrainingRun:
    """One training from data to tested checkpoint."""

    def __init__(self, cfg: DictConfig, part: Part, job: Training) -> None:
        self.cfg, self.part, self.job = cfg, part, job
        L.seed_everything(cfg.seed, verbose=False)
        torch.set_num_threads(cfg.trainer.threads or os.cpu_count() or 1)
        box = [part.vertices.min(0).tolist(), part.vertices.max(0).tolist()]
        model: AttentionVote = instantiate(cfg.model, diameter=part.diameter, box=box, _convert_="all")
        loss = AttentionVoteLoss(part, cfg.loss.weights, LossSettings(**cfg.loss.settings))
        t = cfg.trainer
        self.module = PoseTraining(
            model,
            loss,
            part,
            Schedule(**OmegaConf.to_object(t.schedule)),
            t.optimizer,
            t.learning_rate,
            t.weight_decay,
            t.peak_threshold,
            t.train_heat,
        )
        self.cloud_settings = CloudSettings(
            Sensor(**cfg.data.sensor), cfg.data.density, cfg.data.pool, cfg.data.normal_neighbors
        )
        self.specs = scene_set_specs(part, OmegaConf.to_container(cfg.simulation, resolve=True))
        self.workers = cfg.workers or os.cpu_count() or 1

    def run(self) -> dict[str, Any]:
        """Everything; the dictionary of the JSON line."""
        start = time.monotonic()
        clouds = self._measure()
        data_seconds = time.monotonic() - start
        with self._open_tracking(clouds) as tracked:
            result = self._train_and_test(clouds, tracked, start)
            result |= {"data_seconds": round(data_seconds, 1), "seconds": round(time.monotonic() - start, 1)}
            _write_json(self.job.directory / "result.json", result)
            tracked.log_text("result.json", json.dumps(result, indent=2))
        log.info("see the run with `make ui`")
        return result

    def _measure(self) -> dict[str, Clouds]:
        self.digests: dict[str, str] = {}
        clouds = {}
        for split in ("train", "val", "test"):
            directory = scene_set_directory(Path(self.cfg.root) / "scenes", self.part.name, self.specs[split])
            scenes = generate_scene_set(self.part, self.specs[split], directory, self.workers)
            self.digests[split] = scenes.digest
            root = Path(self.cfg.root) / "clouds"
            clouds[split] = measure_clouds(scenes, self.part, self.cloud_settings, root, self.workers)
        return clouds

    def _open_tracking(self, clouds: dict[str, Clouds]) -> Any:
        from attentionvote import tracking

        cfg, model = self.cfg, self.module.model
        choices = {
            "object": self.part.name,
            "diameter": self.part.diameter,
            "seed": cfg.seed,
            "points": cfg.data.points,
            "parameters": sum(p.numel() for p in model.parameters()),
            "train_scenes": len(clouds["train"]),
            "epochs": cfg.trainer.max_epochs,
            "batch_size": cfg.trainer.batch_size,
            "learning_rate": cfg.trainer.learning_rate,
        }
        name = f"{self.part.name}-{self.job.directory.name}"
        settings = {
            "store": cfg.tracking.store,
            "experiment": self.part.name,
            "name": name,
            "params": choices,
            "config_yaml": OmegaConf.to_yaml(cfg, resolve=True),
            "datasets": self.digests,
            "system_interval_s": cfg.tracking.system_interval,
        }
        try:
            run = tracking.start_run(run_id=self.job.run_id, **settings)
        except ValueError:
            if self.job.run_id is None:
                raise
            log.warning("the MLflow run %s is gone from the store: the training goes on in a new one", self.job.run_id)
            run = tracking.start_run(run_id=None, **settings)
        self.job.directory.mkdir(parents=True, exist_ok=True)
        _write_json(self.job.directory / "run.json", {"run_id": run.id})
        return run

    def _train_and_test(self, clouds: dict[str, Clouds], tracked: Any, start: float) -> dict[str, Any]:
        from attentionvote.tracking import RunLogger

        cfg, module = self.cfg, self.module
        data = PartDataModule(
            clouds["train"],
            clouds["val"],
            clouds["test"],
            cfg.data.points,
            module.model.layout,
            cfg.trainer.batch_size,
            cfg.data.workers,
            Augmentation(**cfg.data.augmentation),
            cfg.seed,
        )
        folder = self.job.directory / "checkpoints"
        best = ModelCheckpoint(folder, "best", monitor="val/ap", mode="max", enable_version_counter=False)
        last = ModelCheckpoint(folder, "last", enable_version_counter=False, save_on_train_epoch_end=True)
        callbacks: list[Callback] = [best, last, TrainingProgress()]
        if cfg.trainer.average_decay:
            callbacks.append(EMAWeightAveraging(decay=cfg.trainer.average_decay, use_buffers=True))
        trainer = L.Trainer(
            accelerator=cfg.trainer.accelerator,
            devices=1,
            precision=self._precision(),
            max_epochs=cfg.trainer.max_epochs,
            gradient_clip_val=cfg.trainer.gradient_clip,
            check_val_every_n_epoch=cfg.trainer.validate_every,
            log_every_n_steps=cfg.trainer.log_every_steps,
            num_sanity_val_steps=0,
            logger=RunLogger(tracked),
            callbacks=callbacks,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=self.job.directory,
        )
        resumed = folder / "last.ckpt"
        log.info(
            "%s: %d scenes, %d epochs, %d parameters%s",
            self.part.name,
            len(data.train),
            cfg.trainer.max_epochs,
            sum(p.numel() for p in module.parameters()),
            ", going on after an interruption" if resumed.exists() else "",
        )
        os.environ["TMPDIR"] = str(self.job.directory)  # Lightning's temporary checkpoint: rename, not copy
        with _quiet_lightning():
            trainer.fit(module, data, ckpt_path=resumed if resumed.exists() else None, weights_only=False)
        if trainer.interrupted:
            raise KeyboardInterrupt
        return self._test(trainer, data, folder / "best.ckpt", tracked, time.monotonic() - start)

    def _test(self, trainer: L.Trainer, data: PartDataModule, path: Path, tracked: Any, seconds: float) -> dict[str, Any]:
        from attentionvote.tracking.figures import ap_threshold_figure, precision_recall_figure
        from attentionvote.tracking.scene_pictures import scene_picture

        module, part = self.module, self.part
        module.load_state_dict(torch.load(path, weights_only=True)["state_dict"])
        module.eval()
        found = {name: [r for b in loader for r in module.detect(b)] for name, loader in (
            ("val", data.val_dataloader()), ("test", data.test_dataloader()))}
        threshold = best_threshold(found["val"], part)
        everything, kept = evaluate(found["test"], part), evaluate(confident(found["test"], threshold), part)
        # Average precision is an area over all confidences; precision and recall belong to the working point.
        metrics = {k: v if k.startswith(("ap_", "map_", "f1_")) else kept.get(k, v) for k, v in everything.items()}
        tracked.log_metrics({f"test/{k}": v for k, v in metrics.items()}, trainer.global_step)
        tracked.log_metrics({"test/confidence_threshold": threshold}, trainer.global_step)
        lines = curves(found["test"], part)
        tracked.log_figure("test/precision_recall.png", precision_recall_figure({"10 % D": (lines.recall, lines.precision)}))
        tracked.log_figure("test/ap_threshold.png", ap_threshold_figure(lines.thresholds, {"test": lines.ap}))
        first = next(iter(data.val_dataloader()))
        for i, inputs in zip(range(2), picture_inputs(module, first, threshold), strict=False):
            tracked.log_figure(f"val/scene_{i}.png", scene_picture(**inputs, title=f"{part.name}, validation scene {i}"))
        return {
            "stage": "train",
            "object": part.name,
            "run_id": tracked.id,
            "checkpoint": str(path),
            "confidence_threshold": threshold,
            "test_scenes": len(found["test"]),
            "train_seconds": round(seconds, 1),
            "metrics": {k: round(v, 4) for k, v in metrics.items()},
        }

    def _precision(self) -> Any:
        if self.cfg.trainer.precision != "auto":
            return self.cfg.trainer.precision
        return "bf16-mixed" if torch.cuda.is_available() and torch.cuda.is_bf16_supported() else "32-true"


def _write_json(path: Path, content: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(content, indent=2) + "\n")
    temporary.replace(path)


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Lightning's advice about worker counts does not fit loaders that cost a few milliseconds a sample."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not have many workers.*")
        yield
