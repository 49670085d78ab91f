"""Learning-rate schedules and the warm-up of the losses, by optimiser step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Shape = Literal["step", "cosine", "constant"]


@dataclass(frozen=True)
class Schedule:
    """How the learning rate and the instance losses' share change over the training.

    Args:
        shape: ``step`` (the paper's: times ``decay`` after each of ``milestones``), ``cosine`` (to zero at the end) or
            ``constant``.
        milestones: epochs after which ``step`` decays.
        decay: factor of each decay.
        rise_steps: steps over which the rate rises from zero to its full value at the start.
        vote_steps: first steps in which only the voting loss acts (section 3.1: warm-up in terms of the loss).
        ramp_steps: steps over which the instance losses then rise to their full weight.
        vote_radius_factor: the voting radius is multiplied by it until the ramp ends (section 4.3: a bigger radius
            benefits the warm-up).
    """

    shape: Shape = "step"
    milestones: Sequence[int] = (5, 10)
    decay: float = 0.1
    rise_steps: int = 0
    vote_steps: int = 0
    ramp_steps: int = 1
    vote_radius_factor: float = 1.0

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise ValueError(f"schedule shape must be one of {', '.join(get_args(Shape))}, got {self.shape!r}")
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
