"""Rows of ``make bench`` about training on a CPU: one set abstraction, and whole steps of both networks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.point_features import CHANNELS, pair_features_reference
from attentionvote.model.pooled_mlp import pooled_mlp, pooled_mlp_reference
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.optimization import optimizer_of
from attentionvote.training.step import batch_loss
from attentionvote.workflows.speed.contest import Contest, Unequal
from attentionvote.workflows.speed.data import slowly
from attentionvote.workflows.speed.material import Material
from attentionvote.workflows.speed.rows import CONV, EAGER

MOST_LAYER_ERROR = 1e-5  # of gradients, relative to their norm
# Of a whole step's: every norm over the batch magnifies rounding, and a near tie in a maximum may go to the other one.
MOST_STEP_ERROR = 1e-2
LAYER_CLOUDS = 2


class Answer(NamedTuple):
    """A value and its gradients."""

    value: Tensor
    gradients: list[Tensor]


class ConvAbstraction(nn.Module):
    """A set abstraction as PointNet++ codes write it: 1x1 convolutions, BatchNorm after each, maximum.

    Not the same function as the product's, whose one norm follows the maximum; the same sizes, and what it is measured
    beside.
    """

    def __init__(self, channels: int, widths: list[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in pairwise([channels, *widths]):
            layers += [nn.Conv2d(a, b, 1, bias=False), nn.BatchNorm2d(b), nn.ReLU(inplace=True)]
        self.mlp = nn.Sequential(*layers)

    def forward(self, geometry: Tensor) -> Tensor:
        """Features ``(batch, out, centers)`` of geometry ``(batch, centers, neighbors, channels)``."""
        out: Tensor = self.mlp(geometry.permute(0, 3, 1, 2)).amax(dim=3)
        return out


def set_abstraction(material: Material) -> Contest:
    """The first level of the full network, norm included: C kernel, the same in plain torch, and the usual layer."""
    size = "full"
    batch, layout = material.batch(size, LAYER_CLOUDS), material.network(size).layout
    layer = copy.deepcopy(material.network(size).backbone.abstractions[0]).train()
    assert isinstance(layer, SetAbstraction)
    widths = [bias.shape[0] for bias in list(layer.weights)[1::2]]
    usual = ConvAbstraction(CHANNELS, widths)
    rows = torch.arange(len(batch.points))[:, None]
    order = batch.neighborhoods.order[:, : layout.centers[0]]
    centers, center_normals = batch.points[rows, order], batch.normals[rows, order]
    neighbors = batch.neighborhoods.neighbors[0]
    direction = torch.randn(*centers.shape[:2], widths[-1], generator=torch.Generator().manual_seed(material.seed))

    def fast() -> Answer:
        out = layer(batch.points, batch.normals, None, centers, center_normals, neighbors)
        return Answer(out.detach(), list(torch.autograd.grad((out * direction).sum(), list(layer.parameters()))))

    def conv() -> Answer:
        geometry = torch.stack([
            pair_features_reference(*cloud, layer.radius)
            for cloud in zip(batch.points, batch.normals, centers, center_normals, neighbors, strict=True)
        ])  # fmt: skip
        out = usual(geometry)
        gradients = torch.autograd.grad((out * direction.mT).sum(), list(usual.parameters()))
        return Answer(out.detach(), list(gradients))

    def kernel(reference: bool) -> Answer:
        """Up to the maximum: the norm over the batch behind it magnifies rounding a hundredfold, in both."""
        weights = [w.detach().requires_grad_() for w in layer.weights]
        cloud = batch.points[0], batch.normals[0], centers[0], center_normals[0], neighbors[0]
        geometry = pair_features_reference(*cloud, layer.radius)
        function = pooled_mlp_reference if reference else pooled_mlp
        out = function(geometry, None, neighbors[0], weights)
        return Answer(out.detach(), list(torch.autograd.grad((out * direction[0]).sum(), weights)))

    def compare(answer: Answer, others: Mapping[str, Answer]) -> str:
        apart = float((answer.value - others[EAGER].value).abs().max())
        if apart > 1e-4:
            raise Unequal(f"features must be those of {EAGER} to 0.0001, got {apart:.1e}")
        return f"gradients of the kernel to {close(kernel(False), kernel(True), MOST_LAYER_ERROR):.0e}"

    channels = "-".join(map(str, [CHANNELS, *widths]))
    text = f"{LAYER_CLOUDS} x {layout.centers[0]:,} centres x {layout.neighbors[0]}, {channels}"
    return Contest(fast, {CONV: conv, EAGER: slowly(fast)}, compare, text, items=LAYER_CLOUDS)


def step(material: Material, size: str) -> Contest:
    """Losses, gradients, clipping, optimiser; neighbours come with the batch, as loader processes send them."""
    cfg, batch = material.trainings[size], material.batch(size)
    loss = AttentionVoteLoss(material.part, asdict(cfg.loss.weights), cfg.loss.settings)

    def contestant() -> Callable[[], Answer]:
        model = copy.deepcopy(material.network(size)).train()
        # A rate of 0: every round is the same step.
        optimizer = optimizer_of(cfg.trainer.optimizer, model.parameters(), 0.0, 0.0, fused=True)

        def run() -> Answer:
            optimizer.zero_grad()
            total = loss.total(batch_loss(model, loss, batch, 1.0, cfg.trainer.train_heat))
            total.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), cfg.trainer.gradient_clip, foreach=True)
            optimizer.step()
            return Answer(total.detach(), [p.grad.clone() for p in model.parameters() if p.grad is not None])

        return run

    def compare(answer: Answer, others: Mapping[str, Answer]) -> str:
        return f"loss and gradients to {close(answer, others[EAGER], MOST_STEP_ERROR):.0e}"

    count = len(batch.points)
    text = f"{count} scenes of {batch.points.shape[1]:,} points"
    return Contest(contestant(), {EAGER: slowly(contestant())}, compare, text, items=count)


def close(answer: Answer, other: Answer, most: float) -> float:
    """The difference of all gradients together, relative to their norm; the values' own where that is greater.

    Raises:
        Unequal: when it is greater than ``most``.
    """
    ours, theirs = (torch.cat([g.flatten() for g in one.gradients]).double() for one in (answer, other))
    value = float((answer.value - other.value).norm() / other.value.norm())
    apart = max(value, float((ours - theirs).norm() / theirs.norm()))
    if not apart <= most:
        raise Unequal(f"values and gradients must agree to {most:g}, got {apart:.1e}")
    return apart
