"""Learning-rate schedules and the warm-up of the losses, by optimiser step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from attentionvote.section import check
from attentionvote.setting import Setting

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
