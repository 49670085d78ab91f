"""The measurement: every model answers every cloud as a cell would, and nothing but the model differs."""

from __future__ import annotations

import numpy as np
import pytest

from attentionvote.data.sensing import CloudSettings, sense
from attentionvote.evaluation import evaluate, left_out_figures
from attentionvote.inference import PoseEstimator, load_bundle
from attentionvote.measurement.models import measure
from attentionvote.measurement.scenes import EvaluationSet
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.sensor import Sensor

SENSOR = Sensor("gaussian", sigma_mm=0.3)


@pytest.fixture(scope="module")
def frozen(make_scenes, box) -> EvaluationSet:
    return EvaluationSet(make_scenes((1, 2, 3)), box, CloudSettings(SENSOR, density=1500, pool=1500))


@pytest.fixture
def make_box_model(make_bundle, trusted_key, box):
    """A bundle of the box; the changes are of the tiny graph."""

    def make(name: str, **changes):
        part = {"digest": box.digest, "name": "box", "diameter": box.diameter}
        return load_bundle(
            make_bundle(name, card={"part": part, **changes.pop("card", {})}, graph=changes), trusted_key
        )

    return make


def test_results_are_the_estimators_own(frozen, make_box_model):
    bundle = make_box_model("model")
    (measured,) = measure([bundle], frozen)
    assert (measured.bundle, measured.working_point, len(measured.results)) == (bundle.digest, 0.5, 3)
    caster = PartCaster(frozen.part)
    with PoseEstimator(bundle) as estimator:
        for record, result in zip(frozen.scenes.records, measured.results, strict=True):
            cloud = sense(record, caster, frozen.settings)[0]
            detections = estimator.estimate_parts_only(cloud.points).detections
            # Every proposal with a peak is there; those above the working point are what a cell gets.
            assert sorted(np.round(result.scores, 2)) == [0.3, 0.7, 0.95]
            kept = result.above(measured.working_point)
            np.testing.assert_array_equal(kept.poses, [d.camera_from_part for d in detections])
            np.testing.assert_array_equal(kept.gt_poses, record.camera_from_part)
            np.testing.assert_allclose(kept.gt_occlusion, 1 - record.visible_fraction)


def test_models_side_by_side_get_the_same_clouds_as_alone(frozen, make_box_model):
    near, far = make_box_model("near"), make_box_model("far", offsets=[[0.03, 0, 0]] * 4)
    alone = [measure([bundle], frozen)[0] for bundle in (near, far)]
    together = measure([near, far], frozen)
    for one, other in zip(alone, together, strict=True):
        assert one.bundle == other.bundle
        for a, b in zip(one.results, other.results, strict=True):
            np.testing.assert_array_equal(a.poses, b.poses)
            np.testing.assert_array_equal(a.scores, b.scores)
    assert not np.allclose(together[0].results[0].poses, together[1].results[0].poses)


def test_figures_are_of_the_results_and_the_clock(frozen, make_box_model):
    (measured,) = measure([make_box_model("model")], frozen)
    figures, part = measured.figures(frozen.part), frozen.part
    assert figures["ap_10"] == evaluate(measured.results, part, add=False)["ap_10"]
    assert (
        figures["precision_10"] == evaluate([r.above(0.5) for r in measured.results], part, add=False)["precision_10"]
    )
    assert 0 < figures["latency_p50_ms"] <= figures["latency_p95_ms"] < 5000
    assert measured.seconds.shape == (3,)
    np.testing.assert_array_equal(measured.cycles, frozen.cycle_of_scene)
    left_out = measured.left_out(part)
    assert {name: figure.value for name, figure in left_out.items()} == pytest.approx(
        {name: figures[name] for name in left_out}
    )
    expected = left_out_figures(measured.results, np.array([0, 0, 1]), part, 0.5)["ap_10"].without
    assert expected.shape == (2,)
    np.testing.assert_array_equal(left_out["ap_10"].without, expected)


def test_a_scene_without_points_is_a_scene_without_results(make_scenes, box, make_box_model):
    empty = EvaluationSet(make_scenes((1,), away=True), box, CloudSettings(SENSOR, density=1500, pool=1500))
    (measured,) = measure([make_box_model("model")], empty)
    assert len(measured.results[0].poses) == 0


def test_the_digest_is_of_everything_that_makes_the_clouds(frozen, make_scenes, box):
    settings = CloudSettings(SENSOR, density=1500, pool=1500)
    assert EvaluationSet(frozen.scenes, box, settings).digest == frozen.digest
    for other in (
        EvaluationSet(make_scenes((1, 2)), box, settings),
        EvaluationSet(frozen.scenes, box, CloudSettings(Sensor("gaussian", sigma_mm=0.4), density=1500, pool=1500)),
        EvaluationSet(frozen.scenes, box, CloudSettings(SENSOR, density=1400, pool=1400)),
    ):
        assert other.digest != frozen.digest


def test_a_model_of_another_part_is_refused_before_any_work(frozen, make_bundle, trusted_key):
    other = load_bundle(make_bundle(), trusted_key)
    with pytest.raises(ValueError, match=r"must be of part box \w{12}, got bracket 000000000000: the part has changed"):
        measure([other], frozen)


def test_the_records_are_shown_to_whoever_wraps_them(frozen, make_box_model):
    seen = []

    def shown(records):
        for record in records:
            seen.append(len(record.camera_from_part))
            yield record

    measure([make_box_model("model")], frozen, shown=shown)
    assert seen == [1, 2, 3]
