"""Layouts, and the neighbourhoods of a sample against loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from attentionvote.geometry import sampling_reference
from attentionvote.model.neighborhoods import Layout, Neighborhoods, find_batch, find_neighborhoods

LAYOUT = Layout((40, 20, 10, 5), (6, 5, 4, 3), (0.02, 0.04, 0.06, 0.12))


def test_levels_are_prefixes_of_one_order_with_the_balls_of_the_level_below(make_cloud: Callable) -> None:
    points = make_cloud(0, 1, 90)[0][0].numpy()
    found = find_neighborhoods(points, LAYOUT)
    order = sampling_reference.farthest_point_order(points, 40)
    np.testing.assert_array_equal(found.order, order)
    below = points
    for size, count, radius, actual in zip(
        LAYOUT.centers, LAYOUT.neighbors, LAYOUT.radii, found.neighbors, strict=True
    ):
        level = points[order[:size]]
        np.testing.assert_array_equal(actual, sampling_reference.ball_query(below, level, radius, count)[0])
        below = level


def test_interpolation_weights_are_inverse_squared_distances(make_cloud: Callable) -> None:
    points = make_cloud(1, 1, 90)[0][0].numpy()
    found = find_neighborhoods(points, LAYOUT)
    levels = [points[found.order[:size]].astype(np.float64) for size in LAYOUT.centers]
    for coarse, fine, nearest, weights in zip(levels[:1:-1], levels[2:0:-1], found.nearest, found.weights, strict=True):
        for row, target in enumerate(fine):
            squared = ((coarse - target) ** 2).sum(1)
            chosen = nearest[row].numpy()
            np.testing.assert_allclose(squared[chosen], np.sort(squared)[:3], atol=1e-12)
            inverse = 1 / (squared[chosen] + 1e-10)
            np.testing.assert_allclose(weights[row], inverse / inverse.sum(), rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(weights.sum(1), torch.ones(len(fine)))
        # Every coarse point is also a fine one: it copies itself (1e-10 m^2 against millimetres).
        assert (weights[: len(coarse), 0] > 0.99).all()


def test_stacking_keeps_every_sample_and_batches_are_found_one_by_one(make_cloud: Callable) -> None:
    points = make_cloud(2, 3, 60)[0]
    together = find_batch(points, LAYOUT)
    for i in range(3):
        alone = Neighborhoods.stack([find_neighborhoods(points[i].numpy(), LAYOUT)])
        for a, b in zip(alone, together, strict=True):
            for x, y in zip(a if isinstance(a, tuple) else [a], b if isinstance(b, tuple) else [b], strict=True):
                assert torch.equal(x[0], y[i])
    moved = together.to("meta")
    assert {t.device.type for t in (moved.order, *moved.neighbors, *moved.nearest, *moved.weights)} == {"meta"}


def test_identical_points_have_finite_weights() -> None:
    found = find_neighborhoods(np.full((50, 3), 0.25, np.float32), LAYOUT)
    for weights in found.weights:
        torch.testing.assert_close(weights, torch.full_like(weights, 1 / 3))


def test_seeds_are_the_centres_of_the_second_level() -> None:
    assert LAYOUT.seeds == 20


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ((4, 3, 2), (4, 4, 4, 4), (1.0,) * 4),
            "a layout must have four levels of centers, neighbors and radii, got 3, 4 and 4",
        ),
        (((4, 3, 2, 1), (4, 4, 4, 4), (1.0,) * 5), "got 4, 4 and 5"),
        (
            ((4, 4, 2, 1), (4, 4, 4, 4), (1.0,) * 4),
            r"centers must fall from level to level and stay positive, got \(4, 4, 2, 1\)",
        ),
        (((4, 3, 2, 0), (4, 4, 4, 4), (1.0,) * 4), r"stay positive, got \(4, 3, 2, 0\)"),
    ],
)
def test_impossible_layouts_are_refused(arguments: tuple, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Layout(*arguments)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ValueError, match=r"a sample must have at least 40 points \(first level\), got 39"):
        find_neighborhoods(np.zeros((39, 3), np.float32), LAYOUT)
