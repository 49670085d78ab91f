"""What must not change a score, and what must: properties of the whole way from poses to figures.

Monotone in the threshold, for the toolbox's rules: whoever is nearest to whom does not depend on the threshold, so with
a larger one every mutual pair stays, true positives never fall, false positives never rise, and with them recall and
precision at every score. AP itself is NOT monotone: it weighs each gain of recall with the precision at the score where
it comes, and a pose that a bad result already finds at a low precision no longer gains at the higher precision of the
nearer result that takes it over (the last test). Without such take-overs it is. COCO's figure, whose matching is
greedy and whose precision is interpolated, is monotone: test_coco_precision.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation import PoseMetric, SceneResult, average_precision
from attentionvote.evaluation.average_precision import summarize
from attentionvote.evaluation.matching import score_curve
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.geometry.symmetry import Symmetry

SYMMETRIES = {
    "none": Symmetry(),
    "cyclic": Symmetry("cyclic", order=2),
    "dihedral": Symmetry("dihedral", order=3),
    "revolution": Symmetry("revolution"),
    "revolution with flip": Symmetry("revolution", flip=True),
}
SEEDS = st.integers(0, 2**32 - 1)
THRESHOLD = 0.006


def metric_of(name: str) -> PoseMetric:
    """Round about the axis, so that every symmetry leaves Lambda alone."""
    return PoseMetric(SYMMETRIES[name], np.diag([0.02, 0.02, 0.04]))


def some_scenes(make_scene, seed: int) -> list[SceneResult]:
    rng = np.random.default_rng(seed)
    return [make_scene(rng, int(r), int(t)) for r, t in rng.integers(0, 14, (4, 2))]


def figures(scenes: list[SceneResult], metric: PoseMetric, threshold: float = THRESHOLD) -> list[float]:
    got = average_precision(scenes, metric, threshold)
    return [got.ap, got.f1, got.map, got.r99, got.r50, got.pooled_ap, got.tp, got.fp, got.fn]


def random_element(symmetry: Symmetry, rng: np.random.Generator) -> np.ndarray:
    turns = symmetry.rotations()
    turn = turns[rng.integers(len(turns))]
    if symmetry.is_revolution:
        turn = turn @ rotation_about(symmetry.axis, rng.uniform(0, 2 * np.pi))
    return transform(turn, np.zeros(3))


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(max_examples=8)
@given(seed=SEEDS)
def test_a_common_motion_of_truth_and_results_changes_nothing(name, make_scene, make_poses, seed):
    scenes, metric = some_scenes(make_scene, seed), metric_of(name)
    motion = make_poses(np.random.default_rng(seed), 1, 3.0)[0]
    moved = [SceneResult(motion @ s.poses, s.scores, motion @ s.gt_poses, s.gt_occlusion) for s in scenes]
    assert figures(moved, metric) == pytest.approx(figures(scenes, metric), abs=1e-12)


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(max_examples=8)
@given(seed=SEEDS)
def test_relabelling_by_a_symmetry_changes_nothing(name, make_scene, seed):
    scenes, metric, rng = some_scenes(make_scene, seed), metric_of(name), np.random.default_rng(seed)

    def relabelled(poses: np.ndarray) -> np.ndarray:
        return np.array([pose @ random_element(metric.symmetry, rng) for pose in poses]).reshape(-1, 4, 4)

    others = [SceneResult(relabelled(s.poses), s.scores, relabelled(s.gt_poses), s.gt_occlusion) for s in scenes]
    assert figures(others, metric) == pytest.approx(figures(scenes, metric), abs=1e-12)


@settings(max_examples=25)
@given(seed=SEEDS)
def test_the_order_of_results_truth_and_scenes_changes_nothing(make_scene, seed):
    # Equal scores enter together, so their order does not count either.
    scenes, metric, rng = some_scenes(make_scene, seed), metric_of("cyclic"), np.random.default_rng(seed)
    shuffled = []
    for index in rng.permutation(len(scenes)):
        s = scenes[index]
        r, t = rng.permutation(len(s.scores)), rng.permutation(len(s.gt_occlusion))
        shuffled.append(SceneResult(s.poses[r], s.scores[r], s.gt_poses[t], s.gt_occlusion[t]))
    assert figures(shuffled, metric) == pytest.approx(figures(scenes, metric), abs=1e-12)


@settings(max_examples=25)
@given(seed=SEEDS, scale=st.sampled_from([1e-3, 1.0, 300.0]), shift=st.sampled_from([-5.0, 0.0, 1.0]))
def test_only_the_order_of_the_scores_counts(make_scene, seed, scale, shift):
    scenes, metric = some_scenes(make_scene, seed), metric_of("none")
    others = [SceneResult(s.poses, scale * s.scores**3 + shift, s.gt_poses, s.gt_occlusion) for s in scenes]
    assert figures(others, metric) == pytest.approx(figures(scenes, metric), abs=1e-12)


@settings(max_examples=25)
@given(seed=SEEDS)
def test_a_stray_of_the_lowest_score_costs_precision_and_no_area(make_scene, seed):
    # Area is gained with recall only; what comes after the last gain costs nothing but a false positive.
    scenes, metric = some_scenes(make_scene, seed), metric_of("none")
    far = transform(np.eye(3), [[50.0, 0, 0]])
    others = [
        SceneResult(np.concatenate([s.poses, far]), np.append(s.scores, -1.0), s.gt_poses, s.gt_occlusion)
        for s in scenes
    ]
    one, other = (average_precision(x, metric, THRESHOLD) for x in (scenes, others))
    assert other.ap == pytest.approx(one.ap, abs=1e-12)
    assert (other.tp, other.fp, other.fn) == (one.tp, one.fp + len(scenes), one.fn)


@settings(max_examples=40)
@given(seed=SEEDS, one=st.floats(0, 0.03), other=st.floats(0, 0.03))
def test_true_positives_never_fall_as_the_threshold_grows(make_scene, seed, one, other):
    scenes, metric = some_scenes(make_scene, seed), metric_of("none")
    low, high = (average_precision(scenes, metric, t) for t in sorted((one, other)))
    assert low.tp <= high.tp
    assert low.fp >= high.fp
    assert low.fn >= high.fn
    assert (low.curve_recall <= high.curve_recall + 1e-12).all()
    assert (low.curve_precision <= high.curve_precision + 1e-12).all()


def test_average_precision_can_fall_as_the_threshold_grows():
    # Truth 0 .. 10. At the high score: three strays and result 3, 8 mm from truth 0. At the low one: results 4 .. 14 on
    # truth 0 .. 10, exact. Up to 5 mm: (0 of 4), then 11 right and 4 wrong: AP = 11/15.
    # Up to 10 mm: 1 right of 4 first, recall 1/11 at precision 1/4; then truth 0 is taken over, the same 11 of 15:
    # AP = 1/4 * 1/11 + 11/15 * 10/11, which is less, though no result has become worse.
    distances = np.full((15, 11), 1.0)
    distances[3, 0] = 0.008
    distances[np.arange(4, 15), np.arange(11)] = 0.0
    scores = np.r_[np.full(4, 0.9), np.full(11, 0.1)]

    def at(threshold: float):
        return summarize([score_curve(distances, scores, np.ones(11, dtype=bool), threshold)])

    near, far = at(0.005), at(0.010)
    assert near.ap == pytest.approx(11 / 15)
    assert far.ap == pytest.approx(1 / 44 + 11 / 15 * 10 / 11)
    assert far.ap < near.ap
    assert (near.tp, near.fp, near.fn) == (far.tp, far.fp, far.fn) == (11, 4, 0)
