"""Figures of several parts: each part as if it were alone, their mean, and what a wrong name costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.evaluation import PoseMetric, SceneResult, evaluate, evaluate_at, left_out_figures
from attentionvote.evaluation.by_part import COUNTS, by_part
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part, PartSet


@pytest.fixture
def scenes() -> list[SceneResult]:
    """Scenes of both parts; some results are near the truth, some far, some under the other part's name."""
    rng, found = np.random.default_rng(0), []
    for count in (5, 3, 0, 4):
        place = rng.uniform([-0.2, -0.2, 0.6], [0.2, 0.2, 1.0], (count, 3))
        truth = transform(matrix_from_quaternion(random_quaternion(rng, (count,))), place)
        kinds = np.arange(count) % 2
        results = np.concatenate([truth, truth[:1]])
        results[:, :3, 3] += rng.normal(0, 0.003, (len(results), 3))
        called = np.concatenate([kinds, kinds[:1]])
        if count > 3:
            called[1] = 1 - called[1]
        found.append(SceneResult(results, rng.random(len(results)), truth, rng.uniform(0, 0.7, count), called, kinds))
    return found


def test_every_part_s_figures_are_those_of_the_part_alone(box_and_slab: PartSet, scenes: list[SceneResult]) -> None:
    together = evaluate(scenes, box_and_slab)
    for k, part in enumerate(box_and_slab.parts):
        own = [
            SceneResult(
                s.poses[s.part_ids == k], s.scores[s.part_ids == k],
                s.gt_poses[s.gt_part_ids == k], s.gt_occlusion[s.gt_part_ids == k],
            )
            for s in scenes
        ]  # fmt: skip
        alone = evaluate(own, part)
        assert {f"{part.name}/{name}" for name in alone} <= together.keys()
        for name, value in alone.items():
            assert together[f"{part.name}/{name}"] == value, name
    for name in evaluate(scenes, box_and_slab.parts[0]).keys() & together.keys():
        values = [together[f"{p.name}/{name}"] for p in box_and_slab.parts if f"{p.name}/{name}" in together]
        expected = sum(values) if name.startswith(COUNTS) else np.mean(values)
        assert together[name] == pytest.approx(expected), name


def test_a_right_pose_under_another_name_is_a_mistake_and_a_miss(box_and_slab: PartSet) -> None:
    pose = transform(np.eye(3), [0, 0, 0.8])[None]
    right = SceneResult(pose, np.ones(1), pose, np.zeros(1), np.ones(1), np.ones(1))
    assert evaluate([right], box_and_slab, add=False)["recall_10"] == 1.0
    wrong = replace(right, part_ids=np.zeros(1))
    figures = evaluate([wrong], box_and_slab, add=False)
    assert (figures["slab/recall_10"], figures["slab/misses_10"], figures["box/strays_10"]) == (0.0, 1.0, 1.0)
    assert figures["strays_10"] == figures["misses_10"] == 1.0


def test_precision_is_of_the_detections_for_every_part(box_and_slab: PartSet, scenes: list[SceneResult]) -> None:
    at, everything = evaluate_at(scenes, box_and_slab, 0.5, add=False), evaluate(scenes, box_and_slab, add=False)
    kept = evaluate([scene.above(0.5) for scene in scenes], box_and_slab, add=False)
    for name in ("ap_10", "slab/ap_10", "box/map_5"):
        assert at[name] == everything[name]
    for name in ("recall_10", "slab/recall_10", "box/strays_10"):
        assert at[name] == kept[name]


def test_the_same_cycles_are_left_out_of_every_part(box_and_slab: PartSet, scenes: list[SceneResult]) -> None:
    cycles = np.array([0, 0, 1, 2])
    figures = left_out_figures(scenes, cycles, box_and_slab, 0.2)
    for name in ("ap_10", "box/ap_5", "slab/recall_10", "recall_10"):
        assert figures[name].value == pytest.approx(evaluate_at(scenes, box_and_slab, 0.2, add=False)[name]), name
        for cycle, without in enumerate(figures[name].without):
            left = [scene for scene, c in zip(scenes, cycles, strict=True) if c != cycle]
            assert without == pytest.approx(evaluate_at(left, box_and_slab, 0.2, add=False)[name]), name
    part_values = [figures[f"{part.name}/ap_10"].without for part in box_and_slab.parts]
    np.testing.assert_allclose(figures["ap_10"].without, np.mean(part_values, axis=0))


def test_what_cannot_be_measured_on_a_part_is_left_out_of_the_mean(box_and_slab: PartSet) -> None:
    def figures_of(_: list[SceneResult], part: Part) -> dict[str, float]:
        return {"error": 2.0, "misses_10": 3.0} if part.name == "slab" else {"misses_10": 1.0}

    expected = {"error": 2.0, "misses_10": 4.0, "box/misses_10": 1.0, "slab/error": 2.0, "slab/misses_10": 3.0}
    assert by_part([], box_and_slab, figures_of) == expected


def test_a_scene_keeps_who_is_who(scenes: list[SceneResult]) -> None:
    scene = scenes[0]
    kept: NDArray = scene.scores >= 0.5
    np.testing.assert_array_equal(scene.above(0.5).part_ids, scene.part_ids[kept])
    assert len(scene.of_part(0).poses) + len(scene.of_part(1).poses) == len(scene.poses)
    assert set(scene.of_part(1).gt_part_ids) == {1}
    plain = SceneResult(scene.poses, scene.scores, scene.gt_poses, scene.gt_occlusion)
    assert not plain.part_ids.any()
    assert len(plain.of_part(1).gt_poses) == 0
    with pytest.raises(ValueError, match=r"part_ids must have shape \(6,\), got \(2,\)"):
        replace(scene, part_ids=[0, 1])


def test_a_metric_of_one_part_does_not_judge_a_set(box_and_slab: PartSet, scenes: list[SceneResult]) -> None:
    with pytest.raises(ValueError, match="a metric belongs to one part, got one with the 2 parts of box_and_slab"):
        evaluate(scenes, box_and_slab, metric=PoseMetric.of(box_and_slab.parts[0]))
