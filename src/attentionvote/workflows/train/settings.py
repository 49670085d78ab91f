"""Settings of a training: ``conf/train.yaml`` and the groups it chooses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.identity import NETWORK
from attentionvote.command.sections import EXECUTOR, SEED, Cluster, Tracking
from attentionvote.data.settings import DataSettings
from attentionvote.model.settings import NetworkSettings
from attentionvote.section import Target
from attentionvote.setting import Setting, SettingError
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

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """Settings of plain containers; the class that files of conf/model named before 0.2 may stand there.

        Raises:
            SettingError: as ``VerbSettings.of``.
        """
        model = plain.get("model")
        if isinstance(model, Mapping) and "_target_" in model:
            if model["_target_"] != NETWORK:
                raise SettingError(f"model._target_ must be left out or {NETWORK}; got {model['_target_']!r}")
            plain = {**plain, "model": {name: value for name, value in model.items() if name != "_target_"}}
        return super().of(plain)
