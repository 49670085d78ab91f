"""Rows of ``make bench`` about one GPU: the same losses and the same network as on a CPU, with everything on it."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch

from attentionvote.model.predictions import Predictions
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.step import batch_loss
from attentionvote.workflows.speed.contest import Contest, NotMeasured, Unequal
from attentionvote.workflows.speed.material import Material

SCENES = 32
MOST_MM = 0.1  # between a GPU's and a CPU's centres
LEAST_SHARE = 0.9


def training(material: Material, device: str = "cuda") -> Contest:
    """A step of the full network in bfloat16, its batch on the GPU."""
    _need(device)
    cfg = material.trainings["full"]
    batch = material.batch("full", 1)
    device_batch = batch.to(device)
    scenes = SCENES if device == "cuda" else 2
    whole = type(device_batch)(*(_repeated(value, scenes) for value in device_batch))
    model = copy.deepcopy(material.network("full")).to(device).train()
    loss = AttentionVoteLoss(material.part, asdict(cfg.loss.weights), cfg.loss.settings)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0, foreach=True)

    def fast() -> float:
        optimizer.zero_grad()
        with torch.autocast(device, torch.bfloat16):
            total = loss.total(batch_loss(model, loss, whole, 1.0, cfg.trainer.train_heat))
        total.backward()
        optimizer.step()
        return float(total.detach())  # waits for the GPU

    def compare(fast: float, _: Mapping[str, Any]) -> str:
        if not fast == fast or abs(fast) == float("inf"):
            raise Unequal(f"the loss must be finite, got {fast}")
        return "finite"

    return Contest(fast, {}, compare, f"{scenes} scenes of {whole.points.shape[1]:,} points", items=scenes)


def inference(material: Material, device: str = "cuda") -> Contest:
    """One cloud on the GPU, order and neighbours computed, beside torch with C kernels on one CPU thread."""
    _need(device)
    batch, reference = material.batch("full", 1), material.network("full")
    model = copy.deepcopy(reference).to(device)
    points, normals = batch.points.to(device), batch.normals.to(device)

    def fast() -> Predictions:
        with torch.no_grad():
            answer = model(points, normals)
        return Predictions(*(value.cpu() for value in answer))

    def on_cpu() -> Predictions:
        with torch.no_grad():
            answer: Predictions = reference(batch.points, batch.normals)
        return answer

    def compare(fast: Predictions, others: Mapping[str, Predictions]) -> str:
        apart_mm = 1e3 * (fast.center - others["CPU"].center).norm(dim=-1)
        share = float((apart_mm <= MOST_MM).float().mean())
        if share < LEAST_SHARE:
            raise Unequal(
                f"{LEAST_SHARE:.0%} of the centres must lie within {MOST_MM} mm of the CPU's, got {share:.0%}"
            )
        return f"{share:.0%} of the centres within {MOST_MM} mm"

    return Contest(fast, {"CPU": on_cpu}, compare, f"{points.shape[1]:,} points")


def champion(material: Material) -> Contest:
    """Whole verbs, run by hand: hours of drops on a CPU are part of it."""
    del material
    raise NotMeasured("run make train, export, evaluate and promote by hand")


def _need(device: str) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        raise NotMeasured("no GPU here")


def _repeated(value: Any, times: int) -> Any:
    """A batch of one, several times."""
    if isinstance(value, torch.Tensor):
        return value.repeat(times, *[1] * (value.dim() - 1))
    repeated_items = [_repeated(item, times) for item in value]
    return type(value)(*repeated_items) if hasattr(value, "_fields") else tuple(repeated_items)
