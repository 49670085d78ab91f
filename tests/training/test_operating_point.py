"""The confidence threshold against trying every one by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from attentionvote.evaluation import SceneResult
from attentionvote.geometry.pose import transform
from attentionvote.training.operating_point import THRESHOLDS, best_threshold, confident


def scene(positions: list[float], scores: list[float], truths: list[float]) -> SceneResult:
    """Unturned parts along x, metres."""

    def poses(xs: list[float]) -> np.ndarray:
        return np.array([transform(np.eye(3), [x, 0, 0.5]) for x in xs]).reshape(-1, 4, 4)

    return SceneResult(poses(positions), np.array(scores), poses(truths), np.zeros(len(truths)))


@pytest.fixture
def scenes() -> list[SceneResult]:
    # Right ones at 0.8 and 0.6, wrong ones at 0.5 and 0.2.
    first = scene([0.001, 0.4, 0.9], [0.8, 0.5, 0.2], [0.0, 0.2])
    return [first, scene([0.501], [0.6], [0.5]), scene([], [], []), scene([], [], [0.1])]


def test_the_threshold_leaves_out_the_wrong_ones_and_is_the_lowest_that_does(
    make_box: Callable, scenes: list[SceneResult]
) -> None:
    threshold = best_threshold(scenes, make_box())
    assert threshold == min(t for t in THRESHOLDS if t > 0.5)
    kept = confident(scenes, threshold)
    assert [s.scores.tolist() for s in kept] == [[0.8], [0.6], [], []]
    assert [len(s.gt_poses) for s in kept] == [2, 1, 0, 1]


def test_confidences_beyond_one_are_searched_where_they_lie(make_box: Callable) -> None:
    # Eq. 10 has confidences of any size: everything right above 4, everything wrong below.
    many = [scene([0.001, 0.4], [4.0 + i, 3.9 - i / 10], [0.0]) for i in range(5)]
    assert 3.9 < best_threshold(many, make_box()) <= 4.0


def test_it_has_the_best_f1_of_all(make_box: Callable) -> None:
    rng = np.random.default_rng(0)
    many = []
    for _ in range(6):
        truths = rng.permutation(20)[:8] * 0.1
        right = rng.random(10) < 0.6
        # Right ones hit their own instance, wrong ones nothing; the right ones tend to have the higher score.
        hits = np.where(right[:8], truths + 0.003, truths + 0.05)
        many.append(scene(list(hits), list(np.clip(rng.random(8) * 0.7 + 0.3 * right[:8], 0, 1)), list(truths)))

    def f1(threshold: float) -> float:
        found = sum(
            np.sum((s.scores >= threshold) & (np.abs(s.poses[:, 0, 3] - s.gt_poses[:, 0, 3]) < 0.01)) for s in many
        )
        given = sum(np.sum(s.scores >= threshold) for s in many)
        return float(2 * found / (given + sum(len(s.gt_poses) for s in many)))

    best = best_threshold(many, make_box())
    scores = [f1(t) for t in THRESHOLDS]
    assert f1(best) == pytest.approx(max(scores))
    assert best == THRESHOLDS[int(np.argmax(np.round(scores, 9)))]


def test_a_narrower_fraction_counts_fewer_as_right(make_box: Callable) -> None:
    # 4 mm off at 100 mm: right at 10 % D, wrong at 2 % D; then only the exact one with the high score counts.
    one = [scene([0.004, 0.5], [0.3, 0.7], [0.0, 0.5])]
    assert best_threshold(one, make_box(), 0.1) == 0.0
    assert best_threshold(one, make_box(), 0.02) == min(t for t in THRESHOLDS if t > 0.3)


@pytest.mark.parametrize(
    "empty", [[], [scene([], [], [])], [scene([], [], [0.1])]], ids=["no scene", "nothing", "missed"]
)
def test_without_detections_everything_is_let_through(make_box: Callable, empty: list[SceneResult]) -> None:
    assert best_threshold(empty, make_box()) == 0.0
