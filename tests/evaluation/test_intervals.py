"""Intervals: each value against the plain evaluation of the scenes left, widths and coverage against what is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from attentionvote.evaluation import LeftOut, SceneResult, evaluate_at, left_out_figures
from attentionvote.geometry.pose import transform
from attentionvote.part import Part

# The cycle of each of the seven scenes; any numbers, in any order.
CYCLES = np.array([4, 4, 9, 2, 9, 9, 4])


def test_every_value_is_the_evaluation_of_the_scenes_that_are_left(
    scenes: list[SceneResult], box: Callable[[], Part]
) -> None:
    part, point = box(), 0.4
    figures = left_out_figures(scenes, CYCLES, part, point)
    assert set(figures) == {"ap_10", "ap_5", "ap_2", "precision_10", "recall_10"}
    for left, number in ((None, None), *enumerate((2, 4, 9))):
        kept = [scene for scene, cycle in zip(scenes, CYCLES, strict=True) if cycle != number]
        expected = evaluate_at(kept, part, point, add=False)
        for name, figure in figures.items():
            value = figure.value if left is None else figure.without[left]
            assert value == pytest.approx(expected[name], abs=1e-12), name
    assert {len(figure.without) for figure in figures.values()} == {3}
    assert len({*figures["ap_10"].without, figures["ap_10"].value}) == 4  # the test can tell them apart


def test_of_one_cycle_nothing_is_known(scenes: list[SceneResult], box: Callable[[], Part]) -> None:
    assert left_out_figures(scenes, np.full(len(scenes), 3), box(), 0.4) == {}


def test_a_model_without_mistakes_is_sure_of_itself(
    make_scene: Callable[..., SceneResult], box: Callable[[], Part]
) -> None:
    truth = make_scene(np.random.default_rng(0), results=0, truths=5)
    perfect = SceneResult(truth.gt_poses, np.ones(5), truth.gt_poses, np.zeros(5))
    sure = left_out_figures([perfect] * 4, np.arange(4), box(), 0.5)["ap_10"].interval()
    assert (sure.low, sure.value, sure.high) == (1, 1, 1)


def jackknifed(values: np.ndarray) -> LeftOut:
    """The mean of cycles as a figure."""
    return LeftOut(float(values.mean()), (values.sum() - values) / (len(values) - 1))


@given(arrays(float, st.integers(2, 40), elements=st.floats(0, 1)))
def test_the_difference_of_means_has_students_interval(values: np.ndarray) -> None:
    none = LeftOut(0.0, np.zeros(len(values)))
    sure = jackknifed(values).minus(none)
    error = values.std(ddof=1) / np.sqrt(len(values))
    expected = stats.t(len(values) - 1).ppf([0.025, 0.975]) * error + values.mean()
    assert (sure.low, sure.high) == pytest.approx(tuple(expected), abs=1e-9)
    assert sure.value == pytest.approx(values.mean())


@given(arrays(float, st.integers(2, 40), elements=st.floats(0, 1)))
def test_the_interval_of_a_share_holds_it_and_only_shares(values: np.ndarray) -> None:
    sure = jackknifed(values).interval()
    assert 0 <= sure.low <= sure.value + 1e-9
    assert sure.value - 1e-9 <= sure.high <= 1


def test_the_interval_of_recall_has_the_width_of_a_proportion(box: Callable[[], Part]) -> None:
    rng, pose = np.random.default_rng(1), transform(np.eye(3), np.zeros(3))[None]
    found = rng.random(400) < 0.8
    none = np.zeros((0, 4, 4))
    scenes = [SceneResult(pose if hit else none, np.ones(int(hit)), pose, np.zeros(1)) for hit in found]
    sure = left_out_figures(scenes, np.arange(400), box(), 0.0)["recall_10"].interval()
    spread = 1.96 * np.sqrt(found.mean() * (1 - found.mean()) / 400)  # of the binomial distribution
    assert (sure.high - sure.low) / 2 == pytest.approx(spread, rel=0.02)
    assert sure.low < found.mean() < sure.high
    assert sure.high - found.mean() < found.mean() - sure.low  # less room above 0.8 than below


def test_the_same_cycles_remove_what_both_models_find_hard(scenes: list[SceneResult], box: Callable[[], Part]) -> None:
    figure = left_out_figures(scenes, CYCLES, box(), 0.0)["ap_10"]
    same = figure.minus(figure)
    assert (same.value, same.low, same.high) == (0, 0, 0)
    other = LeftOut(figure.value, figure.without[::-1])  # as if measured on other cycles
    assert figure.minus(other).high > 0.05


PLACES = transform(np.broadcast_to(np.eye(3), (4, 3, 3)), np.arange(4)[:, None] * [[1.0, 0, 0]])
BESIDE = transform(np.eye(3), [0, 5.0, 0])


def pile(rng: np.random.Generator, ease: float) -> SceneResult:
    """Four parts, each found with the ease of its cycle, and up to two results that are none."""
    found, strays = rng.random(4) < ease, int((rng.random(2) > ease).sum())
    poses = np.concatenate([PLACES[found], BESIDE @ PLACES[:strays]])
    scores = np.concatenate([rng.uniform(0.3, 1, found.sum()), rng.uniform(0, 0.8, strays)])
    return SceneResult(poses, np.round(scores, 2), PLACES, np.zeros(4))


def test_nineteen_of_twenty_intervals_hold_the_figure_of_all_piles(box: Callable[[], Part]) -> None:
    """Sets of 25 cycles of a known population; each scene as a cycle of its own says too little."""
    part, rng, count, sets = box(), np.random.default_rng(0), 25, 100
    population = [[pile(rng, ease) for _ in range(3)] for ease in rng.choice([0.2, 0.6, 1.0], 200)]
    names = ("ap_10", "precision_10", "recall_10")
    known = evaluate_at([scene for cycle in population for scene in cycle], part, 0.5, add=False)
    held = {how: dict.fromkeys(names, 0) for how in ("cycles", "scenes")}
    for _ in range(sets):
        drawn = [scene for index in rng.integers(len(population), size=count) for scene in population[index]]
        for how, numbers in (("cycles", np.repeat(np.arange(count), 3)), ("scenes", np.arange(3 * count))):
            figures = left_out_figures(drawn, numbers, part, 0.5)
            for name in names:
                sure = figures[name].interval()
                held[how][name] += sure.low <= known[name] <= sure.high
    shares = {how: {name: count / sets for name, count in counts.items()} for how, counts in held.items()}
    assert all(0.88 <= share <= 1 for share in shares["cycles"].values()), shares
    assert shares["scenes"]["ap_10"] < 0.87, shares


def test_impossible_requests_are_said(scenes: list[SceneResult], box: Callable[[], Part]) -> None:
    with pytest.raises(ValueError, match=r"cycles must be \(7,\), one number a scene, got \(3,\)"):
        left_out_figures(scenes, np.arange(3), box(), 0.0)
    with pytest.raises(ValueError, match="a difference must be of figures of the same cycles, got 3 and 2"):
        LeftOut(0.5, np.zeros(3)).minus(LeftOut(0.5, np.zeros(2)))
