"""Rows of ``make bench`` about how the cost of a cloud grows: with N, with the instances, with K."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import log2
from typing import Any

import numpy as np
import torch

from attentionvote.data.augmentation import Augmentation
from attentionvote.data.samples import draw_sample
from attentionvote.data.sensing import measure
from attentionvote.geometry.pointcloud import estimate_normals
from attentionvote.workflows.speed.contest import Contest, Goal, Unequal
from attentionvote.workflows.speed.data import tensors
from attentionvote.workflows.speed.material import Material

SHARES = (0.125, 0.25, 0.5, 1.0)


def points(material: Material) -> Contest:
    """Normals, order, neighbours and the compact network on 1/8, 1/4, 1/2 of the full number of points, and on all."""
    model = material.network("compact")
    most = material.trainings["full"].data.points
    sizes = sorted({max(model.layout.centers[0], int(most * share)) for share in SHARES})
    clouds = {f"N = {size:,}": material.sensed(size) for size in sizes}

    def whole(cloud: np.ndarray) -> Callable[[], bool]:
        def run() -> bool:
            normals = torch.from_numpy(estimate_normals(cloud, None))
            with torch.no_grad():
                answer = model(torch.from_numpy(cloud)[None], normals[None])
            return bool(torch.isfinite(answer.center).all())

        return run

    return _grown({name: whole(cloud) for name, cloud in clouds.items()}, sizes)


def instances(material: Material) -> Contest:
    """A new compact sample and the network, with an eighth, a quarter, half of the pile's parts and with all."""
    cfg, model, whole = material.trainings["compact"], material.network("compact"), material.record
    settings = replace(material.cloud_settings("compact"), pool=cfg.data.points)
    count = len(whole.camera_from_part)
    sizes = sorted({max(1, round(count * share)) for share in SHARES})

    def sample(size: int) -> Callable[[], bool]:
        few = replace(
            whole,
            camera_from_part=whole.camera_from_part[:size],
            visible_fraction=whole.visible_fraction[:size],
            part_ids=whole.part_ids[:size],
        )

        def run() -> bool:
            scene = measure(few, material.caster, settings)
            drawn = draw_sample(scene, cfg.data.points, model.layout, Augmentation(), material.rng())
            with torch.no_grad():
                answer = model(drawn.points[None], drawn.normals[None])
            return bool(torch.isfinite(answer.center).all()) and all(np.isfinite(a).all() for a in tensors(drawn))

        return run

    return _grown({f"{size} instances": sample(size) for size in sizes}, sizes)


def proposals(material: Material) -> Contest:
    """The compact network with K = 16, 32, 64, 128, neighbours given."""
    model, batch = material.network("compact"), material.batch("compact", 1)
    sizes = [k for k in (16, 32, 64, 128) if k <= model.layout.seeds]

    def with_proposals(k: int) -> Callable[[], bool]:
        own = copy.copy(model)
        own.proposals = k

        def run() -> bool:
            with torch.no_grad():
                answer = own(batch.points, batch.normals, batch.neighborhoods)
            return answer.center.shape[1] == k and bool(torch.isfinite(answer.center).all())

        return run

    return _grown({f"K = {k}": with_proposals(k) for k in sizes}, sizes)


def _grown(runs: Mapping[str, Callable[[], bool]], sizes: Sequence[int]) -> Contest:
    """The largest size beside all smaller ones, which bound it by N log N."""
    names = list(runs)
    largest = sizes[-1]

    def bound(size: int) -> float:
        return largest * log2(max(largest, 2)) / (size * log2(max(size, 2)))

    goals = tuple(
        Goal(f"<= {bound(size):.3g} x {name}", bound(size), name) for name, size in zip(names[:-1], sizes, strict=False)
    )

    def compare(fast: bool, others: Mapping[str, bool]) -> str:
        if not all((fast, *others.values())):
            raise Unequal("every size must give finite poses, but one does not")
        return "finite at every size"

    references: dict[str, Callable[[], Any]] = {name: runs[name] for name in names[:-1]}
    return Contest(runs[names[-1]], references, compare, names[-1], goals=goals)
