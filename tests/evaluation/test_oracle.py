"""Exact against the benchmark's toolbox: its bunny sample, and random poses of four symmetry classes scored by it.

The data lie beside the repository (../shared/data) and are never committed; without them these tests skip.
Expected figures of the bunny sample: made with the published toolbox (its repository at c726dff9).
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from attentionvote.evaluation import SceneResult, average_precision, match, read_metric, read_scene_results

# threshold as a part of 10 % D: AP, F1, MAP, R99, R50, pooled AP, TP, FP, FN
BUNNY = {
    1.0: (0.797872, 0.882159, 0.798151, 0.787418, 0.798151, 0.795170, 140, 2, 36),
    0.5: (0.797872, 0.882159, 0.798151, 0.787418, 0.798151, 0.795170, 140, 2, 36),
    0.2: (0.765357, 0.852287, 0.764020, 0.670470, 0.771455, 0.761042, 135, 8, 41),
    0.1: (0.698965, 0.792438, 0.702478, 0.291766, 0.716876, 0.693766, 125, 19, 51),
    0.05: (0.510603, 0.625113, 0.512071, 0.156084, 0.563097, 0.506069, 98, 48, 78),
    0.03: (0.232982, 0.387765, 0.245611, 0.006993, 0.286790, 0.223784, 56, 90, 120),
}
BUNNY_ALL_REQUIRED = {
    1.0: (0.176266, 0.299229, 0.176348),
    0.5: (0.176266, 0.299229, 0.176348),
    0.2: (0.167390, 0.286775, 0.167051),
}
BUNNY_OBJECT_SIDE = {
    1.0: (0.797872, 0.882159, 0.798151),
    0.2: (0.765357, 0.852287, 0.764020),
    0.1: (0.690955, 0.783182, 0.694169),
    0.05: (0.496385, 0.612932, 0.501802),
    0.03: (0.234268, 0.394434, 0.246216),
}
BUNNY_SCENE_AP = [
    0.764706,
    0.928571,
    0.833333,
    0.764706,
    0.75,
    0.846154,
    0.8125,
    0.764706,
    0.722222,
    0.769231,
    0.823529,
]
CLASSES = ["none_bunny", "cyclic2_brick", "revolution_noflip_gearshaft", "revolution_flip"]
SIX_DIGITS = {"rtol": 0, "atol": 5.1e-7}


@pytest.fixture(scope="module")
def bunny(shared_data):
    folder = shared_data("sileane_bunny_sample")
    return folder / "poseutils.json", list(read_scene_results(folder / "gt", folder / "results").values())


@pytest.mark.parametrize("factor", BUNNY)
def test_bunny_sample_at_every_threshold(bunny, factor):
    path, scenes = bunny
    metric, threshold = read_metric(path)
    assert threshold == 0.023435524106
    got = average_precision(scenes, metric, factor * threshold)
    figures = (got.ap, got.f1, got.map, got.r99, got.r50, got.pooled_ap)
    np.testing.assert_allclose(figures, BUNNY[factor][:6], **SIX_DIGITS)
    assert (got.tp, got.fp, got.fn) == BUNNY[factor][6:]


@pytest.mark.parametrize("factor", BUNNY_ALL_REQUIRED)
def test_bunny_sample_with_all_truths_required(bunny, factor):
    path, scenes = bunny
    metric, threshold = read_metric(path)
    got = average_precision(scenes, metric, factor * threshold, occlusion_limit=1.1)
    np.testing.assert_allclose((got.ap, got.f1, got.map), BUNNY_ALL_REQUIRED[factor], **SIX_DIGITS)


@pytest.mark.parametrize("factor", BUNNY_OBJECT_SIDE)
def test_bunny_sample_with_the_object_side_frame(bunny, factor):
    path, scenes = bunny
    metric, threshold = read_metric(path, "object")
    got = average_precision(scenes, metric, factor * threshold)
    np.testing.assert_allclose((got.ap, got.f1, got.map), BUNNY_OBJECT_SIDE[factor], **SIX_DIGITS)


def test_bunny_sample_scene_by_scene(bunny):
    path, scenes = bunny
    metric, threshold = read_metric(path)
    assert [int(scene.to_find().sum()) for scene in scenes] == [17, 14, 18, 17, 16, 13, 16, 17, 18, 13, 17]
    assert (sum(len(s.gt_poses) for s in scenes), sum(len(s.poses) for s in scenes)) == (825, 147)
    got = average_precision(scenes, metric, threshold)
    np.testing.assert_allclose([c.average_precision for c in got.per_scene], BUNNY_SCENE_AP, **SIX_DIGITS)
    tables = [metric.distances(s.poses, s.gt_poses) for s in scenes]
    found = [match(d, s.scores, s.to_find(), threshold) for d, s in zip(tables, scenes, strict=True)]
    assert sum(len(m.ignored) for m in found) == 5


@pytest.fixture(scope="module", params=CLASSES)
def oracle(request, shared_data):
    folder = shared_data(f"bregier_oracle/{request.param}")
    metric, threshold = read_metric(folder / "poseutils.json")
    scenes = read_scene_results(folder / "gt", folder / "results")
    return request.param, metric, threshold, scenes, json.loads((folder / "expected.json").read_text())


def limits(key: str) -> tuple[float, float]:
    occlusion, factor = key.removeprefix("occ").split("_thr")
    return float(occlusion), float(factor)


def test_oracle_pair_distances(oracle):
    name, metric, _, scenes, expected = oracle
    ordered = list(scenes.values())
    # The toolbox applies the bunny's Rref2i, which is rounded to six digits.
    tolerance = 1e-6 if name == "none_bunny" else 1e-12
    assert expected["pair_distances"]
    for scene, result, distances in expected["pair_distances"]:
        got = metric.distances(ordered[scene].poses[result], ordered[scene].gt_poses[: len(distances)])[0]
        np.testing.assert_allclose(got, distances, rtol=0, atol=tolerance)


def test_oracle_average_precision_and_curves(oracle):
    _, metric, threshold, scenes, expected = oracle
    assert len(expected["metrics"]) == 6
    for key, case in expected["metrics"].items():
        occlusion_limit, factor = limits(key)
        got = average_precision(list(scenes.values()), metric, factor * threshold, occlusion_limit)
        np.testing.assert_allclose((got.ap, got.f1, got.map), (case["AP"], case["F1"], case["MAP"]), atol=1e-12)
        assert sorted(case["per_scene"]) == list(scenes)
        for curve, scene in zip(got.per_scene, scenes, strict=True):
            wanted = case["per_scene"][scene]
            scores = [np.inf if s is None else s for s in wanted["scores"]]
            np.testing.assert_array_equal(curve.scores, scores, err_msg=f"{key} {scene}")
            np.testing.assert_allclose(curve.precision, wanted["P"], atol=1e-12, err_msg=f"{key} {scene}")
            np.testing.assert_allclose(curve.recall, wanted["R"], atol=1e-12, err_msg=f"{key} {scene}")
            assert curve.average_precision == pytest.approx(wanted["AP"], abs=1e-12)


def test_oracle_classification(oracle):
    _, metric, threshold, scenes, expected = oracle

    def classify(scene: SceneResult, factor: float, occlusion_limit: float) -> dict:
        table = metric.distances(scene.poses, scene.gt_poses)
        found = match(table, scene.scores, scene.to_find(occlusion_limit), factor * threshold)
        lists = found.true_positives, found.false_positives, found.misses
        return {name: values.tolist() for name, values in zip(("tp", "fp", "fn"), lists, strict=True)}

    for key, case in expected["metrics"].items():
        occlusion_limit, factor = limits(key)
        for scene, wanted in case["final"].items():
            got = classify(scenes[scene], factor, occlusion_limit)
            assert got == {name: sorted(values) for name, values in wanted.items()}, f"{key} {scene}"
