"""The MLflow run of a training: what it is told when it is opened, new or again."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attentionvote.command.configuration import leaves
from attentionvote.command.identity import identifies
from attentionvote.command.words import parse
from attentionvote.evaluation.scores import HEADLINES
from attentionvote.files import write_json
from attentionvote.simulation.scene_spec import scene_set_directory
from attentionvote.tracking.datasets import RunDataset
from attentionvote.tracking.run import Run
from attentionvote.tracking.run_opening import start_run
from attentionvote.training.module import PoseTraining
from attentionvote.workflows.train.job import RUN, TrainingJob
from attentionvote.workflows.train.results import FIGURES
from attentionvote.workflows.train.settings import TrainSettings

log = logging.getLogger("attentionvote.train")
DATASET = "dataset.json"
# What a training is identified by otherwise: their values may differ in an interrupted training that goes on.
_OTHERWISE = ("init", "model._target_", "model.classes", "data.dataset", "data.held_out")


def open_tracking(cfg: TrainSettings, job: TrainingJob, module: PoseTraining, processes: int) -> Run:
    """The run of a training, the one it began with where the store still has it.

    Args:
        cfg: the settings whole.
        job: whose folder keeps the run's id.
        module: with the digests of the scenes in its metadata.
        processes: that share the training.
    """
    tracking = cfg.tracking
    settings: dict[str, Any] = {
        "store": tracking.store,
        "experiment": job.part.name,
        "name": run_name(cfg, job),
        "params": parameters(cfg, job, sum(weight.numel() for weight in module.model.parameters())),
        "tags": {"processes": processes, **labels(cfg, job)},
        "config_yaml": cfg.yaml(),
        "datasets": _datasets(cfg, job, module.metadata["data"]),
        "system_interval_s": tracking.system_interval,
        "parent": tracking.parent,
    }
    run_id = job.run_id
    try:
        run = start_run(run_id=run_id, **settings)
    except ValueError:
        if run_id is None:
            raise
        log.warning("the MLflow run %s is gone from the store: the training goes on in a new one", run_id)
        run = start_run(run_id=None, **settings)
    write_json(job.directory / RUN, {"run_id": run.id})
    if job.dataset is not None:
        run.log_text(DATASET, json.dumps(module.metadata["dataset"], indent=2))
    return run


def parameters(cfg: TrainSettings, job: TrainingJob, weights: int) -> dict[str, object]:
    """Parameters of the run: what tells trainings apart at a glance, and every setting that identifies one.

    What may differ when a training goes on (threads, folders, where the store is) is in ``config.yaml`` alone.

    Args:
        cfg: the settings.
        job: the training.
        weights: numbers that are learned.
    """
    settings = {
        key: value if isinstance(value, str) else json.dumps(value)
        for key, value in leaves(cfg.composed)
        if identifies(TrainSettings, key, cfg.composed)
        and not any(key == name or key.startswith(f"{name}.") for name in _OTHERWISE)
        and (job.dataset is None or not key.startswith("simulation."))
    }
    glance: dict[str, object] = {
        "object": job.part.name,
        "diameter": job.part.diameter,
        "seed": cfg.seed,
        "points": cfg.data.points,
        "parameters": weights,
        "train_scenes": job.scene_counts["train"],
        "epochs": cfg.trainer.max_epochs,
        "batch_size": cfg.trainer.batch_size,
        "learning_rate": cfg.trainer.learning_rate,
        "precision": job.precision,
        "model.classes": len(job.part.parts),
    }
    return {**settings, **glance} | ({} if job.dataset is None else {"dataset": str(job.dataset)})


def preset(cfg: TrainSettings) -> str:
    """The experiment that was chosen; ``none`` without."""
    values = [word.value() for word in parse(cfg.words) if word.key_or_group == "experiment" and not word.is_delete()]
    names = values[-1] if values and isinstance(values[-1], list) else values[-1:]
    return "+".join(str(name) for name in names if name is not None) or "none"


def run_name(cfg: TrainSettings, job: TrainingJob) -> str:
    """A name that tells runs apart in a table: part, preset, seed, epochs, the beginning of the digest."""
    return f"{job.part.name} {preset(cfg)} s{cfg.seed} {cfg.trainer.max_epochs}e {job.directory.name[:6]}"


def labels(cfg: TrainSettings, job: TrainingJob) -> dict[str, object]:
    """Tags of the run, to search and group by."""
    tags: dict[str, object] = {
        "preset": preset(cfg),
        "part": job.part.name,
        "part.digest": job.part.digest,
        "sensor": cfg.data.sensor.preset,
        "seed": cfg.seed,
        "training": job.directory.name,
    }
    return tags if cfg.init is None else {**tags, "init": cfg.init}


def description(job: TrainingJob, module: PoseTraining, result: Mapping[str, Any]) -> str:
    """What a complete training is and what it reached, in Markdown.

    Args:
        job: the training.
        module: with the digests of the scenes in its metadata.
        result: its JSON line.
    """
    figures, part, metadata = result["metrics"], job.part, module.metadata
    symmetry = metadata["part"].get("symmetry", {}).get("kind", "of each part")
    facts = {
        "part": f"{part.name}, D = {1000 * part.diameter:.1f} mm, symmetry {symmetry}, `{part.digest[:12]}`",
        "sensor": f"{metadata['clouds']['sensor']['preset']}, {metadata['points']} points of a scene",
        "network": f"{sum(weight.numel() for weight in module.model.parameters()):,} weights",
        "thresholds": f"heat {metadata['peak_threshold']:g}, confidence {result['confidence_threshold']:.4f}",
        "trained": f"{result['steps']} steps in {result['train_seconds']:.0f} s, commit `{result['commit'][:12]}`",
    }
    facts |= {
        f"{split} scenes": f"{count}, `{metadata['data'][split][:12]}`" for split, count in job.scene_counts.items()
    }
    rows = [f"| {name} | {figures[name]:.4f} |" for name in HEADLINES if name in figures]
    card = [f"| {name} | {fact} |" for name, fact in facts.items()]
    head = f"**{part.name}** on {result['test_scenes']} scenes never seen; every figure: `{FIGURES}`"
    return "\n".join([head, "", "| figure | value |", "|---|---|", *rows, "", "| card | |", "|---|---|", *card, ""])


def _datasets(cfg: TrainSettings, job: TrainingJob, digests: Mapping[str, str]) -> dict[str, RunDataset]:
    datasets = {}
    for split, scenes in job.scene_counts.items():
        counts = {"scenes": scenes}
        if job.dataset is None:
            path = scene_set_directory(Path(cfg.root) / "scenes", job.part.name, job.specs[split])
            counts["cycles"] = job.specs[split].cycles
        else:
            path = Path(job.dataset.folder)
        datasets[split] = RunDataset(digests[split], f"{job.part.name}/{split}", path.absolute(), counts)
    return datasets
