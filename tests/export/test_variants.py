"""Every variant of the paper's comparisons takes optimiser steps, and its graph answers as the network does.

Training a few steps is cheap: every combination does. Tracing is not: every choice is in one exported graph at least.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
import warm_starter

import attentionvote
from attentionvote.contract import ModelCard
from attentionvote.data.samples import Batch, collate, draw_sample
from attentionvote.export.checkpoint_card import model_card
from attentionvote.geometry.pose import apply, matrix_from_quaternion, random_quaternion, transform
from attentionvote.inference.runtime import Session
from attentionvote.model.fusion import FUSIONS
from attentionvote.model.neighborhoods import Layout
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part
from attentionvote.scene import Scene
from attentionvote.training.checkpoint import load_trained, save_trained
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.pose_loss import RotationLoss
from attentionvote.training.settings import LossSettings
from attentionvote.training.step import batch_loss

POINTS = 96
SMALL: dict[str, Any] = {
    "centers": [32, 24, 8, 4], "neighbors": [8, 8, 4, 4], "proposals": 6, "gathered": 6, "merge_fraction": None,
    "refinement": None, "vote_rotation": False, "voxel_fraction": 0.3,
}  # fmt: skip
PAPERS = {"rotation": "quaternion", "confidence": "exponential", "center_seed": "voxel"}
# By name what a network changes. The default (aml, heatmap) is exported by test_graph_network.py.
EXPORTED: dict[str, dict[str, Any]] = {
    "amx, heatmap, test radius": PAPERS | {"fusion_kind": "amx", "voting_radius": 0.03, "test_voting_radius": 0.015},
    "pn, fps": {
        "fusion_kind": "pn", "proposal_source": "fps", "voting_radius": 0.03, "merge_fraction": 0.08,
        "refinement_steps": 1, "refinement": {"points": 8, "widths": [8, 16], "head": [16]},
    },
}  # fmt: skip
Graphs = dict[str, tuple[AttentionVote, ModelCard, bytes]]


def bricks(part: Part, layout: Layout, seed: int) -> Batch:
    """Two scenes of three bricks, whose points have made-up normals."""
    rng, samples = np.random.default_rng(seed), []
    for _ in range(2):
        place = np.array([0, 0, 0.5]) + rng.uniform(-1, 1, (3, 3)) * part.diameter
        poses = transform(matrix_from_quaternion(random_quaternion(rng, (3,))), place)
        ids = rng.integers(0, 3, 2 * POINTS).astype(np.int32)
        on_part = part.surface_points(len(ids), rng)
        points = np.stack([apply(poses[i], p[None])[0] for i, p in zip(ids, on_part, strict=True)]).astype(np.float32)
        normals = (-points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
        scene = Scene(points, ids, poses, np.ones(3), np.zeros(3, np.int32), normals)
        samples.append(draw_sample(scene, POINTS, layout, None, rng))
    return collate(samples)


def trained(part: Part, arguments: dict[str, Any], rotation: RotationLoss) -> AttentionVote:
    """The network after two steps, which every weight has felt."""
    torch.manual_seed(0)
    model = AttentionVote.from_arguments(arguments).train()
    weights = {"vote": 1.0, "center": 1.0, "rotation": 1.0, "confidence": 1.0, "refined": 1.0}
    loss = AttentionVoteLoss(part, weights, LossSettings(rotation, assignment=1.0, confidence=model.confidence))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for step in range(2):
        terms = batch_loss(model, loss, bricks(part, model.layout, step), ramp=1.0, least_heat=0.0)
        total = loss.total(terms)
        optimizer.zero_grad()
        total.backward()
        assert total.isfinite()
        assert not [n for n, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
        assert all(p.grad is not None and p.grad.abs().max() > 0 for p in model.fusion.parameters() if p.ndim > 1)
        optimizer.step()
    return model


@pytest.mark.parametrize("rotation", get_args(RotationLoss))
@pytest.mark.parametrize("proposal_source", ["heatmap", "fps"])
@pytest.mark.parametrize("fusion_kind", FUSIONS)
def test_every_combination_trains(
    part: Part,
    make_metadata: Callable[..., dict[str, Any]],
    fusion_kind: str,
    proposal_source: str,
    rotation: RotationLoss,
) -> None:
    choices = PAPERS | {"fusion_kind": fusion_kind, "proposal_source": proposal_source, "voting_radius": 0.03}
    model = trained(part, make_metadata()["model"] | SMALL | choices, rotation).eval()
    batch = bricks(part, model.layout, 9)
    with torch.no_grad():
        answer = model(batch.points, batch.normals, batch.neighborhoods)
    assert all(value.isfinite().all() for value in answer)
    assert (answer.peak_heat > 0).any(1).all()


@pytest.fixture(scope="module")
def graphs(
    part: Part, make_metadata: Callable[..., dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Graphs:
    """Trained networks as they come out of their checkpoints, with their cards and graphs, exported in one process."""
    folder, words, cards = tmp_path_factory.mktemp("variants"), [], []
    for number, changes in enumerate(EXPORTED.values()):
        arguments = make_metadata()["model"] | SMALL | changes
        metadata, files = (
            make_metadata(points=POINTS, model=arguments),
            [f"{number}.{s}" for s in ("ckpt", "json", "onnx")],
        )
        model = trained(part, arguments, "metric")
        save_trained(model, metadata, folder / files[0])
        cards.append(model_card(model, metadata, part, (0.4, 0.7), 0.2))
        (folder / files[1]).write_text(cards[-1].to_json(), encoding="utf-8")
        words += files
    command = [sys.executable, str(Path(__file__).with_name("export_script.py").resolve()), *words]
    done = warm_starter.run(command, cwd=folder, timeout=280, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    networks = [load_trained(folder / name)[0] for name in words[::3]]
    content = [(folder / name).read_bytes() for name in words[2::3]]
    return dict(zip(EXPORTED, zip(networks, cards, content, strict=True), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPORTED)
def test_a_trained_variants_graph_is_the_network(graphs: Graphs, part: Part, name: str) -> None:
    model, card, graph = graphs[name]
    session = Session(graph, card)
    for seed in (7, 8):
        batch = bricks(part, model.layout, seed)
        for points, normals in zip(batch.points, batch.normals, strict=True):
            with torch.no_grad():
                expected = model(points[None], normals[None])
            actual = session.run(points[None].numpy(), normals[None].numpy())
            assert (expected.peak_heat > 0).any()
            assert len(set(np.round(expected.confidence[0].numpy(), 4))) > 2
            for output, value in expected._asdict().items():
                np.testing.assert_allclose(actual[output], value.numpy(), rtol=1e-4, atol=3e-5, err_msg=output)


@pytest.mark.slow
def test_the_same_weights_give_the_same_bytes_from_another_checkout(
    graphs: Graphs, make_metadata: Callable[..., dict[str, Any]], export: Callable[..., bytes], tmp_path: Path
) -> None:
    """In a process of its own; here it was the first of several. The smallest network there is: a trace is dear."""
    name = next(iter(EXPORTED))
    network, card, graph = graphs[name]
    source = tmp_path / "elsewhere" / "src"
    shutil.copytree(Path(attentionvote.__file__).parent, source / "attentionvote")
    arguments = make_metadata()["model"] | SMALL | EXPORTED[name]
    assert export(network, card, tmp_path, source, points=POINTS, model=arguments) == graph


@pytest.mark.slow
def test_the_test_radius_is_in_the_graph_and_on_its_card(graphs: Graphs, part: Part) -> None:
    model, card, graph = graphs["amx, heatmap, test radius"]
    assert card.voting_radius == 0.015
    batch = bricks(part, model.layout, 7)
    points, normals = batch.points[:1], batch.normals[:1]
    answer = Session(graph, card).run(points.numpy(), normals.numpy())["center"]
    try:
        model.test_voting_radius = None
        with torch.no_grad():
            assert np.abs(model(points, normals).center.numpy() - answer).max() > 1e-5
    finally:
        model.test_voting_radius = 0.015
