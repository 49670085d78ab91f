"""Settings of losses, schedule and trainer: the groups ``conf/loss`` and ``conf/trainer``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from attentionvote.section import check
from attentionvote.setting import Identity, Setting
from attentionvote.training.schedule import Schedule

if TYPE_CHECKING:
    from attentionvote.part import Parts

CHANGED = Identity.CHANGED


def _no_share(value: float) -> str:
    if isinstance(value, int) or value <= 1:
        return ""
    return f"must be a share of at most 1.0, or a whole number of batches; got {value}"


LIMIT = Setting(
    "Batches of an epoch, or with a point the share of them; null = all.",
    above=0,
    high=1_000_000,
    identity=CHANGED,
    problem=_no_share,
)
ISOTROPIC = 0.1  # what every part's settings hold; only another value is known to be somebody's choice
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
    isotropic: Annotated[
        float,
        Setting("Share of D added to Lambda in the metric rotation loss, not of bodies of revolution.", low=0, high=10),
    ] = ISOTROPIC
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


def check_isotropic(settings: LossSettings, parts: Parts) -> None:
    """Refuse a share of D chosen for bodies of revolution alone: one axis and its length are all that they have.

    Raises:
        ValueError: with one sentence, when it is neither 0 nor the default that is there for every part.
    """
    if settings.isotropic in (0, ISOTROPIC) or not all(part.symmetry.is_revolution for part in parts.parts):
        return
    what = "a body" if len(parts.parts) == 1 else "a set of bodies"
    raise ValueError(
        f"loss.settings.isotropic must be left at {ISOTROPIC} or be 0 for {parts.name}, {what} of revolution, which it "
        f"does not change: there is no Lambda that it could be added to, got {settings.isotropic:g}"
    )


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
    optimizer: Annotated[str, Setting("Torch's, or muon: see training/muon.py.", choices=("adam", "adamw", "muon"))]
    learning_rate: Annotated[float, Setting("At its highest, see schedule.", above=0, high=10)]
    weight_decay: Annotated[float, Setting("Of the optimizer.", low=0, high=10)]
    gradient_clip: Annotated[float, Setting("Largest norm of the gradient; 0 = not clipped.", low=0, high=1e6)]
    schedule: Schedule
    average_decay: Annotated[
        float, Setting("Moving average of the weights, tested and exported; 0 = none.", low=0, high=0.999999)
    ]
    validate_every: Annotated[int, Setting("Epochs between validations.", low=1, high=1_000_000)]
    log_every_steps: Annotated[
        int, Setting("Steps between logged losses.", low=1, high=1_000_000, identity=Identity.ONCE)
    ]
    precision: Annotated[
        str,
        Setting(
            "auto = bf16 where the GPU is good at it, else 32.",
            choices=("auto", "32-true", "bf16-mixed", "16-mixed", "64-true"),
        ),
    ]
    accelerator: Annotated[str, Setting("Where the network is trained.", choices=("auto", "cpu", "gpu", "cuda", "mps"))]
    threads: Annotated[
        int | None,
        Setting(
            "Of the arithmetic, of each process; null = half of its share of the cores.",
            low=1,
            high=1024,
            identity=Identity.NEVER,
        ),
    ]
    peak_threshold: Annotated[float, Setting("Heat a proposal needs at validation and in the cell.", low=0, high=1000)]
    train_heat: Annotated[float, Setting("Heat a proposal needs to be trained on.", low=0, high=1000)]
    # Switches of Lightning's Trainer by its names.
    max_steps: Annotated[
        int | None,
        Setting("Most optimizer steps; null = max_epochs alone.", low=1, high=1_000_000_000, identity=CHANGED),
    ] = None
    accumulate_grad_batches: Annotated[
        int, Setting("Batches whose gradients make one step.", low=1, high=100_000, identity=CHANGED)
    ] = 1
    limit_train_batches: Annotated[int | float | None, LIMIT] = None
    limit_val_batches: Annotated[int | float | None, LIMIT] = None
    fast_dev_run: Annotated[
        bool | int,
        Setting(
            "So many batches (true = 1) of training and validation, to try the code: nothing is tested or tracked.",
            low=0,
            high=100_000,
            identity=CHANGED,
        ),
    ] = False
    deterministic: Annotated[
        bool, Setting("Only algorithms that give the same bits again, also on a GPU.", identity=CHANGED)
    ] = False
    profiler: Annotated[
        Literal["simple", "advanced", "pytorch"] | None,
        Setting("Of Lightning; its report lies in the training's folder.", identity=Identity.NEVER),
    ] = None

    @property
    def dev_batches(self) -> int:
        """Batches of ``fast_dev_run``, 0 for a training."""
        return int(self.fast_dev_run)

    def steps(self, scenes: int) -> int:
        """Optimizer steps of a training on so many scenes."""
        batches = scenes // self.batch_size
        limit = self.limit_train_batches
        if limit is not None:
            batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        steps = -(-batches // self.accumulate_grad_batches) * self.max_epochs
        return steps if self.max_steps is None else min(steps, self.max_steps)
