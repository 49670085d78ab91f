"""Settings of a training: ``conf/train.yaml`` and the groups it chooses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.sections import EXECUTOR, SEED, Cluster, Tracking
from attentionvote.data.settings import DataSettings
from attentionvote.model.settings import NetworkSettings
from attentionvote.section import Target
from attentionvote.setting import Setting
from attentionvote.simulation.scene_spec import SimulationSettings
from attentionvote.training.settings import Loss, TrainerSettings


@dataclass(frozen=True, kw_only=True)
class TrainSettings(VerbSettings):
    """What determines a training, and how it is run."""

    verb: ClassVar[str] = "train"
    object: Target
    simulation: SimulationSettings
    data: DataSettings
    model: NetworkSettings
    loss: Loss
    trainer: TrainerSettings
    cluster: Cluster
    seed: Annotated[int, SEED]
    root: Annotated[str, Setting("Where scene sets and clouds lie.")]
    outputs: Annotated[str, Setting("Where trainings lie.")]
    resume: Annotated[
        str, Setting("auto: go on with an interrupted training; never: start anew.", choices=("auto", "never"))
    ]
    force: Annotated[bool, Setting("Repeat a training that is complete.")]
    workers: Annotated[
        int | None,
        Setting("Processes for generation and clouds; null = one per core of this machine.", low=1, high=1024),
    ]
    executor: Annotated[str, EXECUTOR]
    tracking: Tracking
