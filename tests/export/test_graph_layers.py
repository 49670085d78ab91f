"""Layers in another order of work beside those they stand for, in several steps and without the exporter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from attentionvote.export import graph_layers, graph_scan
from attentionvote.export.graph_folding import GraphNorm, GraphVoteBranch, folded
from attentionvote.model.backbone import SetAbstraction
from attentionvote.model.fusion import VoteBranch
from attentionvote.model.layers import Residual, RowNorm, shared_mlp
from attentionvote.model.proposals import heatmap_reference
from attentionvote.model.refinement import Refiner
from attentionvote.model.settings import RefinementSettings

CLOSE = {"atol": 2e-6, "rtol": 1e-5}


@pytest.fixture(autouse=True)
def several_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small steps, several of them."""

    def in_blocks(step: Callable[..., Sequence[Tensor]], blocks: Sequence[Tensor], shared: Any) -> list[Tensor]:
        assert len(blocks[0]) > 1
        return graph_scan.in_blocks(step, blocks, shared)

    monkeypatch.setattr(graph_layers, "in_blocks", in_blocks)
    for name, size in (("_ROWS", 64), ("_POSES", 3), ("_PAIRS", 1024)):
        monkeypatch.setattr(graph_layers, name, size)
    torch.manual_seed(3)


def trained(module: nn.Module) -> nn.Module:
    """Norms that are not the identity."""
    for norm in module.modules():
        if isinstance(norm, RowNorm):
            nn.init.uniform_(norm.weight, 0.5, 1.5)
            nn.init.normal_(norm.bias, std=0.3)
            nn.init.normal_(norm.running_mean, std=0.3)
            nn.init.uniform_(norm.running_var, 0.3, 2.0)
    return module.eval().requires_grad_(False)


def directions(*shape: int) -> Tensor:
    return nn.functional.normalize(torch.randn(*shape, 3), dim=-1)


@pytest.mark.parametrize("width_in", [0, 5])
@pytest.mark.parametrize("widths", [[16], [16, 8], [16, 8, 24]])
def test_set_abstraction(width_in: int, widths: list[int]) -> None:
    layer = trained(SetAbstraction(width_in, widths, 0.4, residual=True))
    xyz, index = torch.rand(1, 50, 3), torch.randint(0, 50, (1, 20, 8))
    features = torch.randn(1, 50, width_in) if width_in else None
    index[0, :, 0] = torch.arange(20)  # every centre is its own neighbour, at a distance of zero
    given = xyz, directions(1, 50), features, xyz[:, :20], directions(1, 20), index
    torch.testing.assert_close(graph_layers.GraphSetAbstraction(layer)(*given), layer(*given), **CLOSE)


@pytest.mark.parametrize("points", [5, 64, 400])
@pytest.mark.parametrize("stray", [0.0, 1e9])
def test_refiner(points: int, stray: float) -> None:
    """More and fewer points in a box than are looked at, none, some at its faces, one far behind everything."""
    layer = trained(
        Refiner(RefinementSettings(points, (16, 8), (16,)), 0.3, [[-0.1, -0.04, -0.02], [0.05, 0.04, 0.08]], 4)
    )
    nn.init.normal_(layer.output.weight, std=0.1)
    xyz, center = torch.rand(1, 300, 3) * 0.4, torch.rand(9, 3) * 0.4
    xyz[0, 7, 2] += stray
    center[4] = 5.0
    rotation = torch.linalg.qr(torch.randn(9, 3, 3))[0]
    for start, far in ((20, 1 - 1e-4), (26, 1 + 1e-4)):  # a hair inside and outside of each face of the first box
        low, high = layer.box * far
        faces = torch.cat([torch.diag(low), torch.diag(high)])
        xyz[0, start : start + 6] = center[0] + faces @ rotation[0].T
    given = xyz, directions(1, 300), torch.zeros(9, dtype=torch.long), center, rotation, torch.randn(9, 4)
    for actual, expected in zip(graph_layers.GraphRefiner(layer)(*given), layer(*given), strict=True):
        torch.testing.assert_close(actual, expected, **CLOSE)


@pytest.mark.parametrize("window", [1, 2, 3])
def test_heatmap(window: int) -> None:
    rng = np.random.default_rng(window)
    votes = torch.tensor(rng.normal(0, 0.02, (1, 96, 3)) + rng.integers(0, 2, (1, 96, 1)) * 0.1, dtype=torch.float32)
    heat, beaten, mean = graph_layers.GraphHeatmap()(votes, 0.01, window)
    expected = heatmap_reference(votes, 0.01, window)
    assert 2 <= int((beaten == 0).sum()) < 90
    torch.testing.assert_close(heat, expected[0], **CLOSE)
    torch.testing.assert_close(beaten, expected[1])
    torch.testing.assert_close(mean, expected[2], **CLOSE)


def replaced(layers: nn.Sequential) -> nn.Sequential:
    return folded(nn.Sequential(*(GraphNorm(one) if isinstance(one, RowNorm) else one for one in layers)))


def test_norms_are_folded() -> None:
    layers = trained(nn.Sequential(*shared_mlp(5, [16, 8]), nn.Linear(8, 6), RowNorm(6)))
    short, x = replaced(layers), torch.randn(2, 7, 5)
    assert [type(one) for one in short] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    torch.testing.assert_close(short(x), layers(x), **CLOSE)
    residual, state = trained(Residual(5)), torch.random.get_rng_state()
    expected = residual(x)
    residual.mlp = replaced(residual.mlp)
    torch.testing.assert_close(residual(x), expected, **CLOSE)
    assert torch.equal(torch.random.get_rng_state(), state)  # nothing is drawn for weights that are known


def test_vote_branch() -> None:
    branch = trained(VoteBranch(6, [16, 8, 12]))
    given = torch.randn(4, 5, 3), torch.randn(11, 6), torch.randint(0, 11, (4, 5))
    expected = branch(*given)
    branch.rest = replaced(branch.rest)
    torch.testing.assert_close(GraphVoteBranch(branch)(*given), expected, **CLOSE)
