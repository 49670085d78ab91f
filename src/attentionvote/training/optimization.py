"""Optimizers and learning rates: the paper's, and any of torch's form that a ``_target_`` names."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from attentionvote.section import Factory
from attentionvote.training.muon import Muon
from attentionvote.training.schedule import Schedule


def optimizer_of(
    kind: str | Factory, weights: Iterable[nn.Parameter], rate: float, decay: float, *, fused: bool
) -> Optimizer:
    """An optimizer over weights; biases and norms do not decay.

    Args:
        kind: ``adam`` (the paper's), ``adamw``, ``muon`` (``training.muon``), or what a ``_target_`` names; its own
            ``lr`` and ``weight_decay`` win.
        weights: all.
        rate: learning rate.
        decay: of the weights.
        fused: one pass over each weight instead of ten (Adam); in mixed precision Lightning clips no gradients of such.

    Raises:
        ValueError, TypeError: of the optimizer.
    """
    if kind == "muon":
        return Muon(weights, lr=rate, weight_decay=decay)
    everything = list(weights)
    decayed = [p for p in everything if p.ndim > 1]
    plain = [p for p in everything if p.ndim <= 1]
    if isinstance(kind, str):
        groups = [{"params": decayed, "weight_decay": decay}, {"params": plain, "weight_decay": 0.0}]
        adam = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[kind]
        return adam(groups, lr=rate, foreach=not fused, fused=fused)
    more = {"lr": rate} if "lr" in kind.parameters else {}
    if "weight_decay" in kind.parameters:
        its_decay = kind.arguments.get("weight_decay", decay)
        groups = [{"params": decayed, "weight_decay": its_decay}, {"params": plain, "weight_decay": 0.0}]
    else:
        groups = [{"params": everything}]
    made: Optimizer = kind(groups, **more)
    return made


def clip_gradient(weights: Iterable[nn.Parameter], most: float) -> Tensor:
    """Scale gradients down to a norm, as Lightning does; returns the norm that they had.

    Args:
        weights: with their gradients, in the order of the optimizer.
        most: largest norm; 0 = not clipped.
    """
    everything = list(weights)
    if most > 0:
        return torch.nn.utils.clip_grad_norm_(everything, most)
    return torch.nn.utils.get_total_norm([weight.grad for weight in everything if weight.grad is not None])


def paper_rate(schedule: Schedule, optimizer: Optimizer, total_steps: int, epoch_steps: int) -> dict[str, Any]:
    """The schedule's rate, changed every step, for Lightning's ``configure_optimizers``."""
    factor: Callable[[int], float] = schedule.rate_factor(total_steps, epoch_steps)
    return {"scheduler": torch.optim.lr_scheduler.LambdaLR(optimizer, factor), "interval": "step"}
