"""SIGTERM ends a process of several at once."""

from __future__ import annotations

import signal
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback


class PlainTermination(Callback):
    """Keeps the handler of SIGTERM that was there before Lightning's.

    Lightning answers SIGTERM with a collective operation from inside the handler. ``torchrun`` sends SIGTERM when a
    process has died, and then nobody answers: each of the others would hang until it is killed half a minute later.
    """

    def __init__(self) -> None:
        self.handler: Any = signal.SIG_DFL

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Before Lightning takes the signal."""
        del trainer, pl_module, stage
        self.handler = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """After it has; its end of training puts back what was there before."""
        del trainer, pl_module
        signal.signal(signal.SIGTERM, self.handler)
