"""Settings of a training: ``conf/train.yaml`` and the groups it chooses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Self

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.identity import NETWORK
from attentionvote.command.sections import EXECUTOR, SEED, Cluster, Tracking
from attentionvote.data.settings import DataSettings
from attentionvote.model.settings import NetworkSettings
from attentionvote.section import Factory, Target
from attentionvote.setting import Identity, Setting, SettingError
from attentionvote.simulation.scene_spec import SimulationSettings
from attentionvote.training.schedule import RateSchedule
from attentionvote.training.settings import Loss, TrainerSettings

HOW = Setting("", identity=Identity.NEVER)  # sections that say how the work is done


@dataclass(frozen=True, kw_only=True)
class TrainSettings(VerbSettings):
    """What determines a training, and how it is run."""

    verb: ClassVar[str] = "train"
    elsewhere: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(
            ("devices", "num_nodes", "strategy"), "several processes share a training by `make train PROCESSES=2`"
        ),
        **dict.fromkeys(
            ("ckpt_path", "resume_from_checkpoint", "pretrained"),
            "the same command goes on with an interrupted training, init=FILE begins with the weights of another",
        ),
        "logger": "MLflow is always there, another is loggers.NAME._target_=CLASS or loggers=csv",
        "limit_test_batches": "the test set is tested whole, simulation.cycles.test makes it smaller",
        "limit_predict_batches": "a training does not predict",
        "gradient_clip_val": "trainer.gradient_clip is the largest norm of the gradient",
        "check_val_every_n_epoch": "trainer.validate_every is the number of epochs between validations",
        "log_every_n_steps": "trainer.log_every_steps is the number of steps between logged losses",
        "lr": "trainer.learning_rate is the learning rate at its highest",
        "scheduler": "schedule._target_=CLASS names a schedule of the learning rate",
    }
    object: Target
    simulation: SimulationSettings
    data: DataSettings
    model: NetworkSettings
    loss: Loss
    trainer: TrainerSettings
    optimizer: Annotated[
        Factory | None,
        Setting("Its class by _target_, and its arguments; null = trainer.optimizer.", identity=Identity.CHANGED),
    ] = None
    schedule: Annotated[
        RateSchedule | None,
        Setting("Of the learning rate, by _target_; null = trainer.schedule's.", identity=Identity.CHANGED),
    ] = None
    callbacks: Annotated[
        dict[str, Target], Setting("Lightning's or yours, each by _target_.", identity=Identity.CHANGED)
    ] = field(default_factory=dict)
    loggers: Annotated[dict[str, Target], Setting("Beside MLflow, each by _target_.", identity=Identity.NEVER)] = field(
        default_factory=dict
    )
    init: Annotated[
        str | None,
        Setting(
            "Weights to begin with: a .ckpt file, an MLflow run, or models:/NAME@champion; null = random.",
            identity=Identity.CHANGED,
        ),
    ] = None
    cluster: Annotated[Cluster, HOW]
    seed: Annotated[int, SEED]
    root: Annotated[str, Setting("Where scene sets and clouds lie.", identity=Identity.NEVER)]
    outputs: Annotated[str, Setting("Where trainings lie.", identity=Identity.NEVER)]
    resume: Annotated[
        str,
        Setting(
            "auto: go on with an interrupted training; never: start anew.",
            choices=("auto", "never"),
            identity=Identity.NEVER,
        ),
    ]
    force: Annotated[bool, Setting("Repeat a training that is complete.", identity=Identity.NEVER)]
    workers: Annotated[
        int | None,
        Setting(
            "Processes for generation and clouds; null = one per core of this machine.",
            low=1,
            high=1024,
            identity=Identity.NEVER,
        ),
    ]
    executor: Annotated[str, EXECUTOR]
    tracking: Annotated[Tracking, HOW]

    @property
    def goes_on_exactly(self) -> bool:
        """Whether fewer epochs are the beginning of this training, to the bit: nothing looks ahead to its end."""
        return self.trainer.schedule.shape != "cosine" and self.schedule is None and not self.callbacks

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
