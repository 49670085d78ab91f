"""The flat metrics and the curves on scenes whose figures are known by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from attentionvote.evaluation import PoseMetric, SceneResult, average_precision, curves, evaluate, evaluate_at
from attentionvote.evaluation.average_distance import NearestPointDistance
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry


def moved(*offset_mm: float, degrees: float = 0.0) -> np.ndarray:
    return transform(rotation_about((0, 0, 1), np.radians(degrees)), np.array(offset_mm) / 1000)


@pytest.fixture
def known() -> list[SceneResult]:
    """D = 100 mm. Truths half a metre apart, visible 1, .95, .75, .5 and .3."""
    truths = np.stack([moved(500 * k, 0, 0) for k in range(5)])
    results = [
        moved(1, 0, 0),  # right at every threshold
        moved(4, 0, 0),  # its duplicate at 10 and 5 %, a stray at 2 %
        moved(503, 0, 0),  # right at 10 and 5 %
        moved(1008, 0, 0),  # right at 10 %
        moved(1520, 0, 0),  # never
        moved(2000, 0, 0),  # on the truth that is too occluded: ignored
    ]
    occlusion = 1 - np.array([1, 0.95, 0.75, 0.5, 0.3])
    return [SceneResult(np.stack(results), np.linspace(1, 0.5, 6), truths, occlusion), SceneResult([], [], [], [])]


def test_evaluate_counts_what_was_laid_out(known, box):
    metrics = evaluate(known, box())
    expected = {
        "precision_10": 3 / 5, "recall_10": 3 / 4, "duplicates_10": 1, "strays_10": 1, "misses_10": 1,
        "precision_5": 2 / 5, "recall_5": 2 / 4, "duplicates_5": 1, "strays_5": 2, "misses_5": 2,
        "precision_2": 1 / 5, "recall_2": 1 / 4, "duplicates_2": 0, "strays_2": 4, "misses_2": 3,
        # Pure translations: ADD is the same distance.
        "add_precision_10": 3 / 5, "add_recall_10": 3 / 4, "add_precision_5": 2 / 5, "add_recall_5": 2 / 4,
        "add_precision_2": 1 / 5, "add_recall_2": 1 / 4,
        "recall_visible_50_60": 0, "recall_visible_70_80": 1, "recall_visible_90_100": 1,
        "center_error_mm": 3, "rotation_error_deg": 0,
    }  # fmt: skip
    for n in (10, 5, 2):  # without the limit that makes it cheap
        nearest = average_precision(known, NearestPointDistance.of(box()), n / 1000)
        expected |= {f"add_s_precision_{n}": nearest.precision, f"add_s_recall_{n}": nearest.recall}
    figures = {f"{name}_{n}" for name in ("ap", "map", "f1") for n in (10, 5, 2)}
    assert set(metrics) == set(expected) | figures
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, abs=1e-9)
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    json.dumps(metrics)
    for percent in (10, 5, 2):
        got = average_precision(known, PoseMetric.of(box()), percent / 100 * 0.1)
        assert metrics[f"ap_{percent}"] == got.ap
        assert metrics[f"map_{percent}"] == got.map
        assert metrics[f"f1_{percent}"] == got.f1


def test_evaluate_of_one_threshold_without_add_gives_the_same_figures(known, box):
    cheap, full = evaluate(known, box(), thresholds=(0.05,), add=False), evaluate(known, box())
    assert cheap == {name: full[name] for name in cheap}
    assert {"ap_5", "recall_visible_90_100", "center_error_mm"} <= set(cheap)
    assert not any(name.startswith("add") or name.endswith("_10") for name in cheap)


def test_evaluate_leaves_out_what_cannot_be_measured(box):
    metrics = evaluate([SceneResult([], [], [moved(0, 0, 0)], [0.45])], box(), thresholds=(0.1,), add=False)
    assert metrics["recall_visible_50_60"] == metrics["recall_10"] == metrics["ap_10"] == 0
    assert "center_error_mm" not in metrics
    assert "recall_visible_90_100" not in metrics


def test_evaluate_takes_the_nearest_points_for_add_s(box):
    # Turned over about its long axis a box covers itself: every point is far from its own place, none from another.
    scene = SceneResult([moved(0, 0, 0, degrees=180)], [1.0], [moved(0, 0, 0)], [0.0])
    metrics = evaluate([scene], box())
    assert [metrics[f"{name}_recall_10"] for name in ("add", "add_s")] == [0, 1]
    assert [metrics[f"{name}_precision_10"] for name in ("add", "add_s")] == [0, 1]


def test_a_working_point_leaves_the_areas_and_cuts_the_rest(known, box):
    # Only the first three results, with scores 1, .9 and .8: two of four found, one duplicate.
    everything, cut = evaluate(known, box()), evaluate_at(known, box(), 0.75)
    assert set(cut) == set(everything)
    areas = {name for name in cut if name.startswith(("ap_", "map_", "f1_"))}
    assert {name: cut[name] for name in areas} == {name: everything[name] for name in areas}
    expected = {"precision_10": 2 / 3, "recall_10": 2 / 4, "add_precision_10": 2 / 3, "add_recall_10": 2 / 4}
    assert {name: cut[name] for name in expected} == pytest.approx(expected)
    kept = evaluate([scene.above(0.75) for scene in known], box())
    assert {name: cut[name] for name in set(cut) - areas} == {name: kept[name] for name in set(cut) - areas}


def test_evaluate_names_fractions_of_a_per_cent(known, box):
    assert "ap_2.5" in evaluate(known, box(), thresholds=(0.025,), add=False)


def test_evaluate_measures_rotation_up_to_the_symmetry(box):
    scene = SceneResult([moved(0, 0, 0, degrees=176)], [1.0], [moved(0, 0, 0)], [0.0])
    assert evaluate([scene], box(Symmetry("cyclic", order=2)))["rotation_error_deg"] == pytest.approx(4)
    assert evaluate([scene], box(Symmetry("revolution")))["rotation_error_deg"] == pytest.approx(0, abs=1e-9)
    assert "rotation_error_deg" not in evaluate([scene], box())


def test_evaluate_puts_a_visible_fraction_on_the_edge_into_the_upper_bin(box):
    occlusion = [0.5, 0.4, 0.3, 0.2, 0.1, 1 - 0.7, 0.51, 0.0]
    poses = np.stack([moved(500 * k, 0, 0) for k in range(8)])
    metrics = evaluate([SceneResult(poses[[1, 5, 7]], np.ones(3), poses, occlusion)], box(), add=False)
    names = ("50_60", "60_70", "70_80", "80_90", "90_100")
    assert [metrics[f"recall_visible_{name}"] for name in names] == [0, 1, 0.5, 0, 0.5]


def test_evaluate_uses_the_metric_it_is_given(box):
    far = PoseMetric(Symmetry(), np.eye(3), transform(np.eye(3), [0, 0, 1.0]))
    tilted = [SceneResult([transform(rotation_about((1, 0, 0), 0.02), np.zeros(3))], [1.0], [moved(0, 0, 0)], [0.0])]
    assert evaluate(tilted, box(), add=False)["recall_10"] == 1
    assert evaluate(tilted, box(), add=False, metric=far)["recall_10"] == 0


@pytest.mark.parametrize("thresholds", [(), (0.1, -0.1)])
def test_evaluate_refuses_impossible_thresholds(known, box, thresholds):
    with pytest.raises(ValueError, match="thresholds must be at least one positive fraction of the diameter, got"):
        evaluate(known, box(), thresholds=thresholds)


def test_evaluate_refuses_no_scene(box):
    with pytest.raises(ValueError, match="at least one scene is needed"):
        evaluate([], box())


def test_curves_agree_with_evaluate(known, scenes, box):
    for some in (known, scenes):
        got, metrics = curves(some, box()), evaluate(some, box())
        np.testing.assert_allclose(got.thresholds, np.arange(21) / 200)
        for percent in (10, 5, 2):
            assert got.ap[2 * percent] == pytest.approx(metrics[f"ap_{percent}"])
    assert curves(known, box()).ap[0] == 0.5  # nothing is exactly right: only the empty scene scores
