"""The look from the predicted pose: points in the part's box against a loop; corrections move with the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from attentionvote.model import refinement
from attentionvote.model.refinement import Refiner, points_in_box, points_in_box_reference
from attentionvote.model.settings import RefinementSettings

pytestmark = pytest.mark.usefixtures("kernels")

BOX = torch.tensor([[-0.02, -0.03, -0.05], [0.02, 0.03, 0.01]])


def poses(seed: int, rows: int) -> tuple[Tensor, Tensor]:
    """Centres near half a metre ahead (the first far from every point) and rotations."""
    rng = np.random.default_rng(seed)
    center = rng.normal([0, 0, 0.5], 0.03, (rows, 3))
    center[0] = [3, 0, 0]
    rotation = Rotation.random(rows, random_state=seed).as_matrix()
    return torch.from_numpy(center).float(), torch.from_numpy(rotation).float()


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(1, 20))
def test_points_in_a_box_equal_a_loop(make_cloud: Callable, seed: int, count: int) -> None:
    points, normals = make_cloud(seed, 2, 60)
    center, rotation = poses(seed, 5)
    sample = torch.tensor([0, 1, 0, 1, 1])
    expected = np.zeros((5, count, 6))
    for row in range(5):
        r, c = rotation[row].double().numpy(), center[row].double().numpy()
        local = (points[sample[row]].double().numpy() - c) @ r
        assert np.abs(local[:, None] - BOX.double().numpy()).min() > 1e-9  # nothing on a border
        turned = normals[sample[row]].double().numpy() @ r
        low, high = BOX.double().numpy()
        inside = [i for i in range(60) if (local[i] >= low).all() and (local[i] <= high).all()]
        for k in range(count if inside else 0):
            i = inside[:count][k % min(len(inside), count)]
            expected[row, k] = [*(20 * local[i]), *turned[i]]
    for function in (points_in_box, points_in_box_reference):
        actual = function(points, normals, sample, center, rotation, BOX, 20.0, count)
        np.testing.assert_allclose(actual, expected, atol=1e-4)
    assert (actual[0] == 0).all()


def test_more_points_wanted_than_there_are_repeat_in_turn(make_cloud: Callable) -> None:
    points, normals = make_cloud(0, 1, 3)
    everything = torch.tensor([[-9.0] * 3, [9.0] * 3])
    for function in (points_in_box, points_in_box_reference):
        seen = function(points, normals, torch.tensor([0]), torch.zeros(1, 3), torch.eye(3)[None], everything, 1.0, 7)
        torch.testing.assert_close(seen[0], torch.cat([points[0], normals[0]], -1)[torch.arange(7) % 3])


@pytest.fixture
def refiner() -> Refiner:
    torch.manual_seed(0)
    module = Refiner(RefinementSettings(32, (16, 24), (16,)), 0.1, BOX.tolist(), context=5).eval()
    nn.init.normal_(module.output.weight, std=0.3)
    return module


def test_refiner_looks_at_the_box_with_a_margin_of_six_percent_of_the_diameter(refiner: Refiner) -> None:
    torch.testing.assert_close(refiner.box, BOX + torch.tensor([[-0.006], [0.006]]))


def test_a_new_refiner_changes_next_to_nothing(make_cloud: Callable) -> None:
    torch.manual_seed(0)
    fresh = Refiner(RefinementSettings(32, (16, 24), (16,)), 0.1, BOX.tolist(), context=5).eval()
    points, normals = make_cloud(0, 1, 60)
    center, rotation = poses(0, 4)
    out = fresh(points, normals, torch.zeros(4, dtype=torch.long), center, rotation, torch.randn(4, 5))
    torch.testing.assert_close(out.center, center, rtol=0, atol=2e-4)
    torch.testing.assert_close(out.rotation, rotation, rtol=0, atol=1e-2)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_corrections_move_with_the_scene(make_cloud: Callable, seed: int) -> None:
    torch.manual_seed(0)
    module = Refiner(RefinementSettings(64, (16, 24), (16,)), 0.1, BOX.tolist(), context=5).eval()
    nn.init.normal_(module.output.weight, std=0.3)
    points, normals = make_cloud(seed, 1, 60)
    center, rotation = poses(seed, 4)
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix()).float()
    shift = torch.tensor([0.1, -0.2, 0.05])
    rows, context = torch.zeros(4, dtype=torch.long), torch.zeros(4, 5)
    still = module(points, normals, rows, center, rotation, context)
    moved = module(points @ turn.T + shift, normals @ turn.T, rows, center @ turn.T + shift, turn @ rotation, context)
    assert (still.center - center).abs().max() > 1e-4
    # 1e-7 m of rounding in the points, times 20 per metre, through a random network.
    torch.testing.assert_close(moved.center, still.center @ turn.T + shift, rtol=0, atol=2e-5)
    torch.testing.assert_close(moved.rotation, turn @ still.rotation, rtol=0, atol=1e-3)


def test_the_given_pose_gets_no_gradient_and_every_weight_a_finite_one(make_cloud: Callable, refiner: Refiner) -> None:
    points, normals = make_cloud(1, 1, 60)
    center, rotation = (t.requires_grad_() for t in poses(1, 4))
    context = torch.randn(4, 5, generator=torch.Generator().manual_seed(0))
    out = refiner(points, normals, torch.zeros(4, dtype=torch.long), center, rotation, context)
    (out.center.sum() + out.rotation.sum() + out.score.sum()).backward()
    assert center.grad is None
    assert rotation.grad is None
    assert all(p.grad is not None and p.grad.isfinite().all() for p in refiner.parameters())


@pytest.mark.parametrize("most", [1, 6 * 60 * 2, 6 * 60 * 5])
def test_some_rows_at_a_time_are_the_same_bits(
    make_cloud: Callable, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    points, normals = (t.double() for t in make_cloud(1, 2, 60))  # for which there is no C function
    center, rotation = (t.double() for t in poses(1, 5))
    arguments = points, normals, torch.tensor([0, 1, 0, 1, 1]), center, rotation, BOX.double(), 20.0, 9
    monkeypatch.setattr(refinement, "MOST_NUMBERS", most)
    pieces = []

    def counted(*piece: Any) -> Tensor:
        pieces.append(len(piece[2]))
        return points_in_box_reference(*piece)

    monkeypatch.setattr(refinement, "points_in_box_reference", counted)
    assert torch.equal(points_in_box(*arguments), points_in_box_reference(*arguments))
    assert pieces == {1: [1] * 5, 720: [2, 2, 1], 1800: [5]}[most]
