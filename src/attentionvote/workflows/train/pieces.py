"""The pieces of a training: its settings, module and data, for a script or notebook with a ``Trainer`` of its own.

What ``make train`` adds is identity, resuming, tracking and the test (``run.py``); it takes its module from here.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from attentionvote import __version__
from attentionvote.command.configuration import compose
from attentionvote.command.executors import executor_of
from attentionvote.data.datamodule import PartDataModule, Scenes
from attentionvote.data.sensing import CloudSettings
from attentionvote.execution.hardware import cores
from attentionvote.model.network import AttentionVote
from attentionvote.part import Parts
from attentionvote.training.checkpoint import FORMAT
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.module import PoseTraining
from attentionvote.workflows.train.data import prepare_data
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.network import described, network_arguments
from attentionvote.workflows.train.processes import TrainingProcess
from attentionvote.workflows.train.settings import TrainSettings


def training_settings(*words: str) -> TrainSettings:
    """The settings of a training.

    Args:
        words: as ``make train``'s ARGS, e.g. ``object=gear``, ``experiment=compact``, ``trainer.batch_size=8``.

    Raises:
        ConfigurationError: with one sentence, on what is unknown or impossible.
    """
    return compose(TrainSettings, words)


def pose_training(cfg: TrainSettings, part: Parts | None = None) -> PoseTraining:
    """Network, losses, optimizer and schedule of a training as a Lightning module; weights are random.

    Args:
        cfg: its settings.
        part: its part, where that is loaded already.

    Raises:
        ValueError: when a setting of model, loss or trainer is impossible.
    """
    part, t = part or cfg.object(), cfg.trainer
    arguments = network_arguments(cfg.model, part)
    model = AttentionVote.from_arguments(arguments)
    metadata: dict[str, Any] = {
        "format": FORMAT,
        "version": __version__,
        "model": arguments,
        **described(part),
        "points": cfg.data.points,
        "clouds": asdict(cloud_settings(cfg)),
        "peak_threshold": t.peak_threshold,
        "confidence_threshold": None,
        "data": {},
        "test": {},
    }
    return PoseTraining(
        model,
        AttentionVoteLoss(part, asdict(cfg.loss.weights), cfg.loss.settings),
        part,
        t.schedule,
        cfg.optimizer or t.optimizer,
        t.learning_rate,
        t.weight_decay,
        t.peak_threshold,
        t.train_heat,
        json.loads(json.dumps(metadata)),  # plain values only: what torch.load(weights_only=True) accepts
        cfg.schedule,
    )


def part_data(cfg: TrainSettings, module: PoseTraining) -> PartDataModule:
    """The batches of a training; scenes and clouds that are missing are made, with a progress bar.

    Args:
        cfg: settings of the training.
        module: that it trains.

    Raises:
        ValueError: when the parts of the configuration do not fit together.
    """
    clouds, digests = prepare_data(
        find_training(cfg), cloud_settings(cfg), cfg.root, executor_of(cfg), cfg.workers or cores(), TrainingProcess(),
        lambda _, work: work(),
    )  # fmt: skip
    module.metadata["data"] |= digests
    return data_module(cfg, module, clouds["train"], clouds["val"], clouds["test"])


def data_module(
    cfg: TrainSettings,
    module: PoseTraining,
    train: Scenes,
    val: Scenes,
    test: Scenes,
    process: TrainingProcess | None = None,
    on_gpu: bool = False,
) -> PartDataModule:
    """Batches of measured scenes: of ours, or any sequence of ``attentionvote.scene.Scene`` with normals.

    Args:
        cfg: settings of the training.
        module: that it trains.
        train, val, test: the scenes.
        process: this one among those that share it.
        on_gpu: whether the network is trained on a GPU of NVIDIA's.

    Raises:
        ValueError: when there are too few points or scenes.
    """
    shared = process or TrainingProcess()
    return PartDataModule(
        train,
        val,
        test,
        cfg.data.points,
        module.model.layout,
        cfg.trainer.batch_size,
        cfg.data.workers,
        cfg.data.augmentation,
        cfg.seed,
        shared.rank,
        shared.processes,
        on_gpu,
    )


def cloud_settings(cfg: TrainSettings) -> CloudSettings:
    """What a training measures of a scene."""
    return CloudSettings(cfg.data.sensor, cfg.data.density, cfg.data.pool, cfg.data.normal_neighbors)
