"""Rows of ``make bench`` about the exported graph: beside torch, and inside the cell's estimator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from attentionvote.geometry import native
from attentionvote.inference import PoseEstimator
from attentionvote.inference.bundles.bundle import Bundle
from attentionvote.inference.measured_points import measured_points
from attentionvote.inference.preparation import find_neighbors, prepare
from attentionvote.inference.runtime import Session
from attentionvote.model.predictions import Predictions
from attentionvote.workflows.speed.contest import Contest, Unequal
from attentionvote.workflows.speed.data import slowly
from attentionvote.workflows.speed.material import Material
from attentionvote.workflows.speed.points import cdist_query
from attentionvote.workflows.speed.rows import EAGER, GRAPH

KERNELS, GIVEN = "torch with C kernels", "plain torch, neighbours given"
CELL = "neighbours by the cell's C code, then the graph"
MOST_MM = 0.01
LEAST_SHARE = 0.95  # of proposals: one on the edge of a box or a ball may change sides, as make export reports


def graph(material: Material, size: str) -> Contest:
    """Order and neighbours found in the graph and by torch with C kernels; plain torch is given one or both.

    A cell whose image brings the C code gives them to the graph, too.
    """
    model, batch = material.network(size), material.batch(size, 1)
    session = Session(material.graph(size), material.card(size))
    points, normals = batch.points.numpy(), batch.normals.numpy()

    def eager(found: bool) -> Callable[[], Predictions]:
        def run() -> Predictions:
            with torch.no_grad():
                answer: Predictions = model(batch.points, batch.normals, batch.neighborhoods if found else None)
            return answer

        return run

    def finding() -> Predictions:
        points, layout = batch.points[0], model.layout
        below, neighbors = points, []
        for size, count, radius in zip(layout.centers, layout.neighbors, layout.radii, strict=True):
            centers = points[batch.neighborhoods.order[0, :size]]
            neighbors.append(cdist_query(below, centers, radius, count)[None])
            below = centers
        with torch.no_grad():
            answer: Predictions = model(
                batch.points, batch.normals, batch.neighborhoods._replace(neighbors=tuple(neighbors))
            )
        return answer

    def in_a_cell() -> dict[str, NDArray]:
        return session.run(points, normals, neighbors=find_neighbors(points, session.layout))

    def compare(fast: dict[str, NDArray], others: Mapping[str, Any]) -> str:
        shares, in_cell = [], others[CELL]
        if any(not np.array_equal(value, in_cell[name]) for name, value in fast.items()):
            raise Unequal("the graph must answer the same when it is given its neighbours, but it answers otherwise")
        for name in (EAGER, GIVEN, KERNELS):
            apart_mm = 1e3 * np.linalg.norm(fast["center"] - others[name].center.numpy(), axis=-1)
            share = float((apart_mm <= MOST_MM).mean())
            if share < LEAST_SHARE:
                wanted = f"{LEAST_SHARE:.0%} of the proposals must lie within {MOST_MM} mm"
                raise Unequal(f"{wanted} of those of {name}, got {share:.0%}")
            shares.append(share)
        return f"{min(shares):.0%} of the proposals within {MOST_MM} mm"

    text = f"{points.shape[1]:,} points"
    references: dict[str, Callable[[], Any]] = {
        EAGER: slowly(finding), GIVEN: slowly(eager(True)), KERNELS: eager(False), CELL: in_a_cell
    }  # fmt: skip
    return Contest(lambda: session.run(points, normals), references, compare, text)


def cell(material: Material, size: str) -> Contest:
    """The shipped estimator on a cloud as dense as its card allows, beside the graph on what it prepared."""
    for file in ("pointops.c", "normals.c"):  # as in the cell's image; a cell compiles nothing
        native.load("attentionvote.geometry", file)
    card, model = material.card(size), material.graph(size)
    estimator = PoseEstimator(Bundle(material.folder, card, "0" * 64, model))
    session, cloud = Session(model, card), material.sensed(card.density)
    prepared = prepare(measured_points(cloud, card), card)

    def compare(fast: Any, others: Mapping[str, dict[str, NDArray]]) -> str:
        outputs = others[GRAPH]
        answered = outputs["center"][0][(outputs["confidence"][0] > 0) & (outputs["peak_heat"][0] > 0)]
        found = np.array([one.camera_from_part[:3, 3] for one in fast.detections])
        apart = np.abs(found[:, None] - answered[None]).sum(-1).min(1) if len(answered) else np.full(len(found), np.inf)
        if not len(found) or apart.max() > 1e-6:
            raise Unequal(f"the cell's {len(found)} poses must be the graph's {len(answered)}, but they are others")
        return f"{len(found)} poses are the graph's"

    text = f"{len(cloud):,} points sent, {card.points:,} in the graph"
    references = {GRAPH: lambda: session.run(prepared.points, prepared.normals)}
    return Contest(lambda: estimator.estimate(cloud), references, compare, text)
