"""Learning-rate schedules and the warm-up of the losses, by optimiser step."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from attentionvote.section import Factory, check, located
from attentionvote.setting import Setting, SettingError

if TYPE_CHECKING:
    from torch.optim import Optimizer

JUDGED_BY = "val/ap"  # what the best checkpoint has most of
Shape = Literal["step", "cosine", "constant"]


@dataclass(frozen=True)
class Schedule:
    """How the learning rate and the instance losses' share change over the training.

    Raises:
        SettingError: when a setting is out of its range.
        ValueError: when the milestones do not rise.
    """

    shape: Annotated[
        Shape,
        Setting("step (the paper's: times decay after each of milestones), cosine (to zero at the end) or constant."),
    ] = "step"
    milestones: Annotated[tuple[int, ...], Setting("Epochs after which step decays.", low=1, high=1_000_000)] = (5, 10)
    decay: Annotated[float, Setting("Factor of each decay.", above=0, high=1)] = 0.1
    rise_steps: Annotated[
        int, Setting("Steps over which the rate rises from zero at the start.", low=0, high=1_000_000_000)
    ] = 0
    vote_steps: Annotated[
        int,
        Setting("First steps with the voting loss alone (section 3.1: warm-up).", low=0, high=1_000_000_000),
    ] = 0
    ramp_steps: Annotated[
        int, Setting("Steps over which the instance losses then rise to their weight.", low=0, high=1_000_000_000)
    ] = 1
    vote_radius_factor: Annotated[
        float,
        Setting("Of the voting radius until the ramp ends (section 4.3: helps the warm-up).", above=0, high=100),
    ] = 1.0

    def __post_init__(self) -> None:
        check(self)
        if list(self.milestones) != sorted(set(self.milestones)):
            raise ValueError(f"milestones must be rising epochs, got {list(self.milestones)}")

    def rate_factor(self, total_steps: int, steps_per_epoch: int) -> Callable[[int], float]:
        """The factor of the learning rate as a function of the step."""

        def factor(step: int) -> float:
            rise = min(1.0, (step + 1) / self.rise_steps) if self.rise_steps else 1.0
            if self.shape == "cosine":
                return rise * 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, total_steps))))
            if self.shape == "step":
                epoch = step // max(1, steps_per_epoch)
                return rise * self.decay ** sum(epoch >= m for m in self.milestones)
            return rise

        return factor

    def ramp(self, step: int) -> float:
        """Share of the instance losses in [0, 1]: 0 during the warm-up, then rising."""
        return min(1.0, max(0.0, (step - self.vote_steps + 1) / max(1, self.ramp_steps)))


@dataclass(frozen=True)
class RateSchedule(Factory):
    """A section that names a class of ``torch.optim.lr_scheduler``, or one that works alike.

    Attributes:
        interval: whether it goes on with every ``step`` or every ``epoch``; as Lightning has it the latter, but for a
            schedule over a total number of steps.
    """

    interval: str = "epoch"
    given: ClassVar[int] = 1

    @classmethod
    def of(cls, values: Mapping[str, Any], key: str = "") -> Self:
        """As ``Target.of``; ``interval`` is ours, not the target's."""
        arguments = {name: value for name, value in values.items() if name != "interval"}
        made = super().of(arguments, key)
        interval = values.get("interval", "step" if "total_steps" in made.parameters else "epoch")
        if interval not in ("step", "epoch"):
            raise SettingError(f"{key}.interval must be one of step, epoch; got {interval!r}")
        return cls(made.path, made.arguments, interval)

    def configured(self, optimizer: Optimizer, total_steps: int, every_epochs: int) -> dict[str, Any]:
        """For Lightning's ``configure_optimizers``.

        Args:
            optimizer: whose rate it changes.
            total_steps: of the training, where the schedule asks for them.
            every_epochs: epochs between validations, after which a schedule that judges the score is told it.
        """
        more: dict[str, Any] = {}
        if "total_steps" in self.parameters and not {"epochs", "steps_per_epoch"} & self.arguments.keys():
            more["total_steps"] = total_steps
        judging = "metrics" in inspect.signature(located(self.path).step).parameters
        if judging and "mode" in self.parameters:
            more["mode"] = "max"
        configured: dict[str, Any] = {"scheduler": self(optimizer, **more), "interval": self.interval}
        if judging:
            configured |= {"monitor": JUDGED_BY, "frequency": every_epochs}
        return configured
