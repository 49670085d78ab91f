"""Average precision: cases known by hand, and the definition computed score by score as the oracle."""

from __future__ import annotations

import numpy as np
import pytest

from attentionvote.evaluation import PoseMetric, SceneResult, average_precision
from attentionvote.evaluation.average_precision import summarize
from attentionvote.evaluation.matching import score_curve
from attentionvote.geometry.pose import transform
from attentionvote.geometry.symmetry import Symmetry

METRIC = PoseMetric(Symmetry(), np.eye(3) * 0.02)


def at(*x: float) -> np.ndarray:
    return transform(np.eye(3), np.array([[v, 0, 0] for v in x], dtype=float).reshape(-1, 3))


def scene(results: list[float], scores: list[float], truths: list[float], occlusion: list[float] | None = None):
    return SceneResult(at(*results), np.array(scores), at(*truths), np.array(occlusion or np.zeros(len(truths))))


def slow_figures(scenes, threshold, limit=0.5):
    """Mean precision and recall at every score, each scene classified anew from the results above it."""
    levels = [np.inf, *sorted({float(s) for x in scenes for s in x.scores}, reverse=True)]
    precision, recall = [], []
    for level in levels:
        p, r = [], []
        for x in scenes:
            tp = fp = 0
            kept = [i for i in range(len(x.scores)) if x.scores[i] >= level]
            d = METRIC.distances(x.poses, x.gt_poses)
            for i in kept:
                near = len(x.gt_poses) > 0 and d[i].min() <= threshold
                truth = int(d[i].argmin()) if near else -1
                if not near or min(kept, key=lambda k: d[k, truth]) != i:
                    fp += 1
                elif x.gt_occlusion[truth] <= limit:
                    tp += 1
            required = int((x.gt_occlusion <= limit).sum())
            p.append(tp / (tp + fp) if tp + fp else 1.0)
            r.append(tp / required if required else 1.0)
        precision.append(np.mean(p))
        recall.append(np.mean(r))
    ap = sum(p * (r - q) for p, r, q in zip(precision, recall, [0.0, *recall], strict=False))
    return ap, max(2 * p * r / (p + r) for p, r in zip(precision, recall, strict=True) if p + r), precision, recall


@pytest.mark.parametrize("threshold", [0.002, 0.005, 0.01])
def test_average_precision_agrees_with_the_definition(scenes, threshold):
    ap, f1, precision, recall = slow_figures(scenes, threshold)
    got = average_precision(scenes, METRIC, threshold)
    np.testing.assert_allclose(got.curve_precision, precision, atol=1e-12)
    np.testing.assert_allclose(got.curve_recall, recall, atol=1e-12)
    assert (got.ap, got.f1) == (pytest.approx(ap, abs=1e-12), pytest.approx(f1, abs=1e-12))
    assert got.map == pytest.approx(np.mean([slow_figures([x], threshold)[0] for x in scenes]), abs=1e-12)


def test_average_precision_of_a_perfect_detector_is_one():
    got = average_precision([scene([0, 1], [0.9, 0.8], [0, 1]), scene([2], [5], [2])], METRIC, 0.01)
    assert (got.ap, got.f1, got.map, got.r99, got.r50, got.pooled_ap) == pytest.approx((1,) * 6)
    assert (got.precision, got.recall, got.tp, got.fp, got.fn) == (1, 1, 3, 0, 0)


def test_average_precision_depends_on_the_order_of_the_scores():
    # Right then wrong: precision 1 at recall 1/2. Wrong then right: precision 1/2 at recall 1/2.
    assert average_precision([scene([0, 5], [2, 1], [0, 1])], METRIC, 0.01).ap == pytest.approx(0.5)
    assert average_precision([scene([0, 5], [1, 2], [0, 1])], METRIC, 0.01).ap == pytest.approx(0.25)
    assert average_precision([scene([0, 5], [1, 1], [0, 1])], METRIC, 0.01).ap == pytest.approx(0.25)


def test_average_precision_averages_scenes_not_detections():
    # Scene A: 1 of 1 found at score 2. Scene B: 1 of 3 found at score 1, after a stray at score 3.
    both = [scene([0], [2], [0]), scene([9, 1], [3, 1], [1, 2, 3])]
    got = average_precision(both, METRIC, 0.01)
    assert got.curve_scores.tolist() == [np.inf, 3, 2, 1]
    np.testing.assert_allclose(got.curve_precision, [1, 0.5, 0.5, 0.75])
    np.testing.assert_allclose(got.curve_recall, [0, 0, 0.5, 2 / 3])
    assert got.ap == pytest.approx(0.5 * 0.5 + 0.75 / 6)
    assert got.map == pytest.approx((1 + 0.5 / 3) / 2)
    assert got.pooled_ap == pytest.approx(1 / 2 * 1 / 4 + 2 / 3 * 1 / 4)
    assert (got.precision, got.recall) == (pytest.approx(2 / 3), pytest.approx(0.5))


def test_average_precision_requires_an_occlusion_of_exactly_one_half():
    results = [scene([], [], [0, 1, 2], [0.5, np.nextafter(0.5, 1), -0.2])]
    assert average_precision(results, METRIC, 0.01).fn == 1


def test_average_precision_ignores_a_result_on_an_occluded_truth():
    got = average_precision([scene([0, 1], [2, 1], [0, 1], [0.9, 0.1])], METRIC, 0.01)
    assert (got.tp, got.fp, got.fn, got.ap) == (1, 0, 0, 1)


def test_average_precision_of_empty_scenes():
    nothing_there = scene([7], [1], [])
    nothing_found = scene([], [], [0])
    assert average_precision([nothing_there], METRIC, 0.01).ap == 1
    alone = average_precision([nothing_found], METRIC, 0.01)
    assert (alone.ap, alone.f1, alone.precision, alone.recall) == (0, 0, 1, 0)
    both = average_precision([nothing_there, nothing_found], METRIC, 0.01)
    assert (both.map, both.curve_precision.tolist()) == (0.5, [1, 0.5])


def test_recall_at_precision_counts_a_recovered_precision():
    def dips(*right: bool):
        table = np.where(np.array(right)[:, None], 1 - np.eye(len(right)), 2)
        scores = np.arange(len(right), 0, -1.0)
        return summarize([score_curve(table, scores, np.ones(len(right), dtype=bool), 0.5)])

    got = dips(False, True, True, False, False, False)
    # Precision 0, 1/2, 2/3, 1/2, 2/5, 1/3: last at least one half with two of six found.
    assert (got.r50, got.r99) == (pytest.approx(2 / 6), 0)


def test_average_precision_refuses_what_has_no_meaning():
    with pytest.raises(ValueError, match="at least one scene is needed to compute an average precision, got none"):
        average_precision([], METRIC, 0.01)
    with pytest.raises(ValueError, match="threshold must be a distance of at least 0 metres, got nan"):
        average_precision([scene([], [], [])], METRIC, float("nan"))
