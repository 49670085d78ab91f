"""Matching: cases known by hand, and a slow matching at every score as the oracle of the running curve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation import match
from attentionvote.evaluation.matching import score_curve


def slow_match(distances, scores, to_find, threshold, lowest=-np.inf):
    """Rules 1-4 of the specification, one result after the other."""
    positives = [p for p in range(len(scores)) if scores[p] >= lowest]
    tp, fp, ignored = [], [], []
    for p in positives:
        truth = int(np.argmin(distances[p])) if distances.shape[1] else None
        near = truth is not None and distances[p, truth] <= threshold
        if not near or min((distances[q, truth], -scores[q], q) for q in positives)[2] != p:
            fp.append(p)
        elif to_find[truth]:
            tp.append((p, truth))
        else:
            ignored.append(p)
    missed = [t for t in np.flatnonzero(to_find) if t not in {t for _, t in tp}]
    return tp, fp, ignored, missed


def table(*rows: list[float]) -> np.ndarray:
    return np.array(rows, dtype=np.float64)


ALL = np.array([True, True])


def test_match_gives_a_truth_to_the_nearer_result_not_to_the_higher_score():
    found = match(table([0.3, 9], [0.1, 9]), np.array([0.9, 0.2]), ALL, 1.0)
    assert found.true_positives.tolist() == [[1, 0]]
    assert found.duplicates.tolist() == found.false_positives.tolist() == [0]
    assert found.misses.tolist() == [1]


def test_match_counts_a_duplicate_on_an_occluded_truth_as_false_positive():
    found = match(table([0.3, 9], [0.1, 9]), np.ones(2), np.array([False, True]), 1.0)
    assert (found.ignored.tolist(), found.duplicates.tolist(), found.misses.tolist()) == ([1], [0], [1])
    assert found.pairs.tolist() == [[1, 0]]


def test_match_accepts_a_distance_equal_to_the_threshold():
    assert match(table([1.0, 2]), np.ones(1), ALL, 1.0).true_positives.tolist() == [[0, 0]]
    assert match(table([1.0, 2]), np.ones(1), ALL, np.nextafter(1.0, 0)).strays.tolist() == [0]


def test_match_looks_only_at_the_nearest_truth_of_a_result():
    # Result 1 is nearest to truth 0, which result 0 holds; that it is also near the free truth 1 does not help.
    found = match(table([0.1, 9], [0.2, 0.3]), np.ones(2), ALL, 1.0)
    assert (found.duplicates.tolist(), found.misses.tolist()) == ([1], [1])


def test_match_of_equally_near_results_prefers_the_higher_score():
    distances = table([0.2, 9], [0.2, 9])
    assert match(distances, np.array([0.1, 0.9]), ALL, 1.0).true_positives.tolist() == [[1, 0]]
    assert match(distances, np.array([0.5, 0.5]), ALL, 1.0).true_positives.tolist() == [[0, 0]]


@pytest.mark.parametrize(("results", "truths"), [(0, 0), (0, 2), (3, 0)])
def test_match_and_curve_of_an_empty_side(results, truths):
    distances, to_find = np.zeros((results, truths)), np.ones(truths, dtype=bool)
    found = match(distances, np.arange(results), to_find, 1.0)
    assert (len(found.strays), len(found.misses), len(found.pairs)) == (results, truths, 0)
    curve = score_curve(distances, np.arange(results, dtype=float), to_find, 1.0)
    assert curve.false_positives.tolist() == list(range(results + 1))
    assert curve.recall.tolist() == [0.0 if truths else 1.0] * (results + 1)
    assert curve.average_precision == (0.0 if truths else 1.0)


def test_curve_enters_results_of_equal_score_together():
    distances = table([0.1, 9], [9, 5], [9, 0.1])
    curve = score_curve(distances, np.array([0.5, 0.5, 0.2]), ALL, 1.0)
    assert curve.scores.tolist() == [np.inf, 0.5, 0.2]
    assert curve.precision.tolist() == [1.0, 0.5, 2 / 3]
    assert curve.recall.tolist() == [0.0, 0.5, 1.0]
    assert curve.average_precision == pytest.approx(0.5 * 0.5 + 0.5 * 2 / 3)


def test_curve_lets_a_late_nearer_result_take_a_truth_away():
    # Result 1 is nearest to truth 1 but also nearer to truth 0 than result 0: truth 0 is lost, recall falls.
    distances = table([0.3, 9, 9], [0.2, 0.1, 9], [9, 0.05, 9])
    curve = score_curve(distances, np.array([3.0, 2.0, 1.0]), np.ones(3, dtype=bool), 1.0)
    assert curve.true_positives.tolist() == [0, 1, 1, 1]
    assert curve.false_positives.tolist() == [0, 0, 1, 2]


def test_curve_with_a_result_limit_divides_by_the_smaller_number():
    distances = table([0.1, 9], [9, 0.1], [5, 5])
    scores = np.array([0.2, 0.9, 0.5])
    curve = score_curve(distances, scores, ALL, 1.0, result_limit=1)
    assert (curve.required, curve.recall.tolist()) == (1, [0.0, 1.0])
    found = match(distances, scores, ALL, 1.0, result_limit=1)
    assert found.true_positives.tolist() == [[1, 1]]
    assert len(found.false_positives) == 0
    with pytest.raises(ValueError, match="result_limit must be at least 1, or absent, got 0"):
        match(distances, scores, ALL, 1.0, result_limit=0)


@settings(max_examples=150)
@given(st.integers(0, 9), st.integers(0, 6), st.integers(0, 2**32 - 1), st.sampled_from([None, 1, 4]))
def test_match_and_curve_agree_with_the_slow_matching(results, truths, seed, limit):
    rng = np.random.default_rng(seed)
    # Few distinct distances and scores: ties are the rule.
    distances = rng.integers(0, 8, (results, truths)) / 4
    scores = rng.integers(0, 4, results) / 2
    to_find = rng.random(truths) < 0.6
    kept = np.sort(np.argsort(-scores, kind="stable")[:limit])
    slow = slow_match(distances[kept], scores[kept], to_find, 1.0)
    fast = match(distances, scores, to_find, 1.0, limit)
    assert fast.true_positives.tolist() == [[kept[p], t] for p, t in slow[0]]
    assert fast.false_positives.tolist() == [kept[p] for p in slow[1]]
    assert fast.ignored.tolist() == [kept[p] for p in slow[2]]
    assert fast.misses.tolist() == slow[3]
    curve = score_curve(distances, scores, to_find, 1.0, limit)
    assert curve.scores.tolist() == [np.inf, *sorted(set(scores[kept].tolist()), reverse=True)]
    for k, lowest in enumerate(curve.scores):
        tp, fp, _, _ = slow_match(distances[kept], scores[kept], to_find, 1.0, lowest)
        assert (curve.true_positives[k], curve.false_positives[k]) == (len(tp), len(fp))


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0, 2), st.floats(0, 2))
def test_recall_grows_with_the_threshold(seed, one, other):
    rng = np.random.default_rng(seed)
    distances, scores, to_find = rng.random((8, 5)) * 2, rng.random(8), rng.random(5) < 0.7
    low, high = (score_curve(distances, scores, to_find, t) for t in sorted((one, other)))
    assert (low.recall <= high.recall).all()
    assert (low.false_positives >= high.false_positives).all()
