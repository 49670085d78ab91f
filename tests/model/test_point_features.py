"""What a centre is told about its neighbours: C kernel, torch reference and open-coded numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from attentionvote.model.point_features import CHANNELS, pair_features, pair_features_reference

pytestmark = pytest.mark.usefixtures("kernels")


def inputs(seed: int, sources: int = 9, centers: int = 4, neighbors: int = 5) -> tuple:
    """Points, normals, centres that are the first points, their normals, and indices: a centre may be its neighbour."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.05, 0.05, (sources, 3)).astype(np.float32)
    normals = rng.normal(size=(sources, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    index = rng.integers(0, sources, (centers, neighbors))
    index[:, 0] = np.arange(centers)
    return points, normals, points[:centers], normals[:centers], index


def by_hand(points, normals, centers, center_normals, index, radius) -> np.ndarray:  # type: ignore[no-untyped-def]
    out = np.zeros((*index.shape, CHANNELS))
    for c, row in enumerate(index):
        for j, i in enumerate(row):
            d = points[i].astype(np.float64) - centers[c]
            length = np.linalg.norm(d)
            u = d / (length + 1e-6)
            cosines = [center_normals[c] @ u, normals[i] @ u, center_normals[c] @ normals[i]]
            out[c, j] = [*(d / radius), *normals[i], length / radius, *cosines]
    return out


@given(st.integers(0, 2**31), st.integers(4, 12), st.integers(1, 6))
def test_kernel_and_reference_equal_the_open_form(seed: int, sources: int, neighbors: int) -> None:
    arrays = inputs(seed, sources, neighbors=neighbors)
    expected = by_hand(*arrays, 0.02)
    tensors = [torch.from_numpy(a) for a in arrays]
    for function in (pair_features, pair_features_reference):
        np.testing.assert_allclose(function(*tensors, 0.02), expected, rtol=1e-4, atol=1e-5)


def test_a_point_that_is_its_own_neighbour_has_no_offset_and_no_angle() -> None:
    features = pair_features(*(torch.from_numpy(a) for a in inputs(0)), 0.02)[:, 0]
    torch.testing.assert_close(features[:, [0, 1, 2, 6, 7, 8]], torch.zeros(4, 6))
    torch.testing.assert_close(features[:, 9], torch.ones(4))


@given(st.integers(0, 2**31))
def test_distance_and_cosines_do_not_turn_with_the_scene_and_the_rest_does(seed: int) -> None:
    points, normals, _, _, index = inputs(seed)
    turn = Rotation.random(random_state=seed % 1000).as_matrix()
    shift = np.array([0.3, -0.2, 0.7])
    sets = []
    for r, t in ((np.eye(3), 0.0), (turn, shift)):
        p, n = (points @ r.T + t).astype(np.float32), (normals @ r.T).astype(np.float32)
        sets.append(pair_features(*map(torch.from_numpy, (p, n, p[:4], n[:4], index)), 0.02).double().numpy())
    still, turned = sets
    # Shifted by a metre, float32 coordinates keep 6e-8 m; an offset of 1 mm then turns by 1e-4.
    far = still[..., 6:7] > 0.1
    np.testing.assert_allclose(turned[..., :3], still[..., :3] @ turn.T, atol=2e-5)
    np.testing.assert_allclose(turned[..., 3:6], still[..., 3:6] @ turn.T, atol=1e-6)
    np.testing.assert_allclose(turned[..., 6:] * far, still[..., 6:] * far, atol=2e-4)


def test_32_bit_indices_give_the_same() -> None:
    points, normals, centers, directions, index = (torch.from_numpy(a) for a in inputs(3))
    wide = pair_features(points, normals, centers, directions, index, 0.02)
    torch.testing.assert_close(pair_features(points, normals, centers, directions, index.int(), 0.02), wide)


def test_gradients_of_the_kernel_are_none_and_of_the_reference_finite() -> None:
    tensors = [torch.from_numpy(a) for a in inputs(1)]
    tensors[0].requires_grad_()
    assert not pair_features(*tensors, 0.02).requires_grad
    (gradient,) = torch.autograd.grad(pair_features_reference(*tensors, 0.02).sum(), tensors[0])
    assert gradient.isfinite().all()
