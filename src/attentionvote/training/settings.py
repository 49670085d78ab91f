"""Settings of losses, schedule and trainer: the groups ``conf/loss`` and ``conf/trainer``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from attentionvote.section import check
from attentionvote.setting import Setting
from attentionvote.training.schedule import Schedule

RotationLoss = Literal["metric", "slerp", "minra", "nlerp"]


@dataclass(frozen=True)
class LossWeights:
    """What each term of the loss counts, in units of the metric; 0 leaves a term out."""

    vote: Annotated[float, Setting("Offsets of the votes.", low=0, high=1000)]
    vote_rotation: Annotated[float, Setting("Rotations of the votes (model.vote_rotation).", low=0, high=1000)]
    center: Annotated[float, Setting("Centres of the proposals.", low=0, high=1000)]
    rotation: Annotated[float, Setting("Rotations of the proposals.", low=0, high=1000)]
    semantic: Annotated[float, Setting("Classes of the proposals.", low=0, high=1000)]
    confidence: Annotated[float, Setting("Confidences of the proposals.", low=0, high=1000)]
    refined: Annotated[float, Setting("Poses after the refinement.", low=0, high=1000)]


@dataclass(frozen=True)
class LossSettings:
    """Choices of the loss; the terms' weights are beside it.

    Raises:
        SettingError: when a setting is out of its range.
    """

    rotation: Annotated[RotationLoss, Setting("Distance of rotations, see training/pose_loss.py.")] = "metric"
    isotropic: Annotated[float, Setting("Share of D added to Lambda in the metric rotation loss.", low=0, high=10)] = (
        0.1
    )
    assignment: Annotated[
        float, Setting("Share of D within which a centre seed belongs to an instance.", above=0, high=10)
    ] = 0.2
    least_visible: Annotated[
        float, Setting("Instances with less visible fraction, and invisible ones, are never assigned.", low=0, high=1)
    ] = 0.05
    confidence: Annotated[
        Literal["exponential", "quality"],
        Setting("exponential (Eq. 10), or quality: the expected share of 2, 5 and 10 % D that the pose meets."),
    ] = "quality"
    one_per_instance: Annotated[
        bool, Setting("Whether all but the best of several proposals on one instance count as 0 in quality.")
    ] = True
    rows_per_scene: Annotated[
        int,
        Setting("Most proposals trained on, on average over the batch; an even choice of all.", low=1, high=100_000),
    ] = 64
    detach_confidence: Annotated[bool, Setting("Whether Eq. 10 leaves the pose's gradient alone.")] = True

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Loss:
    """The group ``loss``."""

    weights: LossWeights
    settings: LossSettings


@dataclass(frozen=True)
class TrainerSettings:
    """The group ``trainer``."""

    max_epochs: Annotated[int, Setting("Epochs of the training.", low=1, high=1_000_000)]
    batch_size: Annotated[int, Setting("Scenes of a batch, of all processes together.", low=1, high=100_000)]
    optimizer: Annotated[str, Setting("Of torch.", choices=("adam", "adamw"))]
    learning_rate: Annotated[float, Setting("At its highest, see schedule.", above=0, high=10)]
    weight_decay: Annotated[float, Setting("Of the optimizer.", low=0, high=10)]
    gradient_clip: Annotated[float, Setting("Largest norm of the gradient; 0 = not clipped.", low=0, high=1e6)]
    schedule: Schedule
    average_decay: Annotated[
        float, Setting("Moving average of the weights, tested and exported; 0 = none.", low=0, high=0.999999)
    ]
    validate_every: Annotated[int, Setting("Epochs between validations.", low=1, high=1_000_000)]
    log_every_steps: Annotated[int, Setting("Steps between logged losses.", low=1, high=1_000_000)]
    precision: Annotated[
        str,
        Setting(
            "auto = bf16 where the GPU is good at it, else 32.",
            choices=("auto", "32-true", "bf16-mixed", "16-mixed", "64-true"),
        ),
    ]
    accelerator: Annotated[str, Setting("Where the network is trained.", choices=("auto", "cpu", "gpu", "cuda", "mps"))]
    threads: Annotated[
        int | None, Setting("Of the arithmetic, of each process; null = its share of the cores.", low=1, high=1024)
    ]
    peak_threshold: Annotated[float, Setting("Heat a proposal needs at validation and in the cell.", low=0, high=1000)]
    train_heat: Annotated[float, Setting("Heat a proposal needs to be trained on.", low=0, high=1000)]
