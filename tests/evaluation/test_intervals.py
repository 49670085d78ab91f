"""The bootstrap: each draw against the plain evaluation of the scenes it drew, intervals against known spreads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.evaluation import SceneResult, evaluate, interval, resampled_figures, scene_weights
from attentionvote.geometry.pose import transform


def test_every_draw_is_the_evaluation_of_the_scenes_it_drew(scenes, box):
    part, point = box(), 0.4
    weights = scene_weights(len(scenes), 12, seed=3)
    figures = resampled_figures(scenes, part, point, weights)
    assert set(figures) == {"ap_10", "ap_5", "ap_2", "precision_10", "recall_10"}
    for draw, row in enumerate(weights.astype(int)):
        drawn = [scene for scene, count in zip(scenes, row, strict=True) for _ in range(count)]
        everything = evaluate(drawn, part, add=False)
        kept = evaluate([scene.above(point) for scene in drawn], part, add=False)
        expected = {name: (everything if name.startswith("ap") else kept)[name] for name in figures}
        assert {name: values[draw] for name, values in figures.items()} == pytest.approx(expected, abs=1e-12)


def test_more_draws_than_one_chunk_continue_the_same_figures(scenes, box):
    weights = scene_weights(len(scenes), 250)
    whole = resampled_figures(scenes, box(), 0.0, weights)
    tail = resampled_figures(scenes, box(), 0.0, weights[150:])
    for name, values in whole.items():
        assert values.shape == (250,)
        np.testing.assert_allclose(values[150:], tail[name], atol=1e-12)


def test_a_model_without_mistakes_is_sure_of_itself(make_scene, box):
    truth = make_scene(np.random.default_rng(0), results=0, truths=5)
    perfect = SceneResult(truth.gt_poses, np.ones(5), truth.gt_poses, np.zeros(5))
    figures = resampled_figures([perfect] * 4, box(), 0.5, scene_weights(4, 30))
    assert all((values == 1).all() for values in figures.values())
    assert interval(figures["ap_10"]).low == interval(figures["ap_10"]).high == 1


def test_the_interval_of_recall_has_the_width_of_a_proportion(box):
    rng, pose = np.random.default_rng(1), transform(np.eye(3), np.zeros(3))[None]
    found = rng.random(400) < 0.8
    none = np.zeros((0, 4, 4))
    scenes = [SceneResult(pose if hit else none, np.ones(int(hit)), pose, np.zeros(1)) for hit in found]
    draws = resampled_figures(scenes, box(), 0.0, scene_weights(400, 2000))["recall_10"]
    sure = interval(draws)
    spread = 1.96 * np.sqrt(found.mean() * (1 - found.mean()) / 400)  # of the binomial distribution
    assert (sure.high - sure.low) / 2 == pytest.approx(spread, rel=0.1)
    assert sure.low < found.mean() < sure.high


def test_pairs_of_draws_remove_what_both_models_find_hard(scenes, box):
    weights = scene_weights(len(scenes), 300)
    ours = resampled_figures(scenes, box(), 0.0, weights)["ap_10"]
    again = resampled_figures(scenes, box(), 0.0, weights)["ap_10"]
    unpaired = resampled_figures(scenes, box(), 0.0, scene_weights(len(scenes), 300, seed=1))["ap_10"]
    assert interval(ours - again) == interval(np.zeros(1))
    assert interval(ours - unpaired).high > 0.05


@given(st.integers(1, 30), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_every_draw_has_as_many_scenes_as_the_set(count, draws, seed):
    weights = scene_weights(count, draws, seed)
    assert weights.shape == (draws, count)
    assert (weights.sum(1) == count).all()
    assert (weights == scene_weights(count, draws, seed)).all()


def test_impossible_requests_are_said(scenes, box):
    with pytest.raises(ValueError, match=r"weights must be \(draws, 7\), one column a scene, got \(2, 3\)"):
        resampled_figures(scenes, box(), 0.0, np.ones((2, 3)))
    with pytest.raises(ValueError, match="at least one scene and one draw, got 0 and 5"):
        scene_weights(0, 5)
    with pytest.raises(ValueError, match=r"draws and a level between 0 and 1, got 0 and 0\.95"):
        interval(np.zeros(0))
    with pytest.raises(ValueError, match="got 3 and 1"):
        interval(np.zeros(3), 1)
