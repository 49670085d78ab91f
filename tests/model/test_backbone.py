"""Set abstraction and feature propagation against loops over points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from attentionvote.model.backbone import Backbone, FeaturePropagation, SetAbstraction
from attentionvote.model.neighborhoods import Layout, Neighborhoods, find_neighborhoods
from attentionvote.model.point_features import pair_features_reference

pytestmark = pytest.mark.usefixtures("kernels")


def numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().numpy()


@pytest.mark.parametrize("with_features", [True, False])
@pytest.mark.parametrize("widths", [(8, 16), (8, 12)], ids=["kernel", "reference"])
def test_set_abstraction_equals_a_loop_over_centres(make_cloud: Callable, with_features: bool, widths: tuple) -> None:
    points, normals = make_cloud(0, 2, 20)
    rng = np.random.default_rng(0)
    features = torch.from_numpy(rng.normal(size=(2, 20, 5)).astype(np.float32)) if with_features else None
    neighbors = torch.from_numpy(rng.integers(0, 20, (2, 6, 4)))
    torch.manual_seed(0)
    layer = SetAbstraction(5 if with_features else 0, widths, 0.03, residual=True).eval()
    for bias in layer.weights[1::2]:
        nn.init.normal_(bias)
    nn.init.uniform_(layer.norm.running_var, 0.5, 2)
    actual = numpy(layer(points, normals, features, points[:, :6], normals[:, :6], neighbors))
    w1, b1, w2, b2 = (numpy(w) for w in layer.weights)
    for sample in range(2):
        for c in range(6):
            rows = neighbors[sample, c]
            given = points[sample], normals[sample], points[sample, c : c + 1], normals[sample, c : c + 1]
            x = numpy(pair_features_reference(*given, rows[None], 0.03))[0] @ w1.T + b1
            if features is not None and layer.project is not None:
                x = x + numpy(features[sample, rows]) @ numpy(layer.project.weight).T
            best = (np.maximum(x, 0) @ w2.T + b2).max(0)
            normed = best / np.sqrt(numpy(layer.norm.running_var) + layer.norm.eps)
            block = layer.residual(torch.from_numpy(np.maximum(normed, 0)).float()[None])
            np.testing.assert_allclose(actual[sample, c], numpy(block)[0], rtol=1e-3, atol=1e-4)


def test_feature_propagation_interpolates_beside_the_own_features() -> None:
    rng = np.random.default_rng(0)
    coarse, fine = (torch.from_numpy(rng.normal(size=s).astype(np.float32)) for s in ((2, 5, 3), (2, 7, 4)))
    nearest = torch.from_numpy(rng.integers(0, 5, (2, 7, 3)))
    weights = torch.from_numpy(rng.dirichlet([1, 1, 1], (2, 7)).astype(np.float32))
    layer = FeaturePropagation(3, 4, [6]).eval()
    actual = layer(coarse, fine, nearest, weights)
    for sample in range(2):
        for t in range(7):
            mean = sum(weights[sample, t, k] * coarse[sample, nearest[sample, t, k]] for k in range(3))
            expected = layer.mlp(torch.cat([mean, fine[sample, t]])[None])[0]
            torch.testing.assert_close(actual[sample, t], expected, rtol=1e-4, atol=1e-5)


def test_backbone_gives_one_feature_a_seed_in_farthest_point_order(make_cloud: Callable) -> None:
    layout = Layout((24, 12, 6, 3), (4, 4, 3, 2), (0.02, 0.04, 0.06, 0.12))
    backbone = Backbone(layout, [(8, 8), (8, 16), (8, 8), (8, 24)], (16, 20), residual=False).train()
    points, normals = make_cloud(1, 3, 40)
    found = Neighborhoods.stack([find_neighborhoods(p.numpy(), layout) for p in points])
    xyz, features = backbone(points, normals, found)
    assert xyz.shape == (3, 12, 3)
    assert features.shape == (3, 12, backbone.width) == (3, 12, 20)
    for i in range(3):
        assert torch.equal(xyz[i], points[i][found.order[i, :12]])
    features.square().sum().backward()
    for name, parameter in backbone.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        # A constant before a norm has no influence: the last bias of each set abstraction.
        if not name.endswith("weights.3"):
            assert parameter.grad.abs().max() > 0, name
