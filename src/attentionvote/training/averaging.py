"""The moving average of the weights, which is judged and kept instead of the last step's."""

from __future__ import annotations

import lightning as L
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn


class MovingAverage(EMAWeightAveraging):
    """Lightning's exponential moving average of weights and buffers, in a form of its own on a GPU.

    Lightning's goes from weight to weight, some hundred small kernels a step, and asks the device twice a step how
    often it has averaged. On a GPU all weights are averaged in a few operations and the count stays on the CPU; on a
    CPU the bits are those of every earlier training.

    Args:
        decay: share of the average that stays.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(decay=decay, use_buffers=True)
        self.decay = decay

    @property
    def state_key(self) -> str:
        """The name in checkpoints, those of earlier trainings included."""
        return EMAWeightAveraging.__qualname__

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Make the average, on the device of the weights."""
        grouped = averages_in_groups(pl_module.device)
        if grouped:
            self._kwargs = {"multi_avg_fn": get_ema_multi_avg_fn(self.decay)}
        super().setup(trainer, pl_module, stage)
        if grouped and self._average_model is not None:
            self._average_model.n_averaged = self._average_model.n_averaged.cpu()


def averages_in_groups(device: torch.device) -> bool:
    """Whether all weights are averaged together: anywhere but on a CPU."""
    return device.type != "cpu"
