"""COCO's average precision: the published rule written once more, slowly, and small cases with their arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from attentionvote.evaluation.coco_precision import ImageErrors, coco_precision, interpolated_precision, match_greedily


def slow_precision(images: list[ImageErrors], threshold: float) -> float | None:
    """The rule in words: match, list, and for each of 101 recalls the best precision of any longer list."""
    listed, required = [], 0
    for image in images:
        required += sum(bool(c) for c in image.counts)
        free = set(range(len(image.counts)))
        ranked = sorted(range(len(image.scores)), key=lambda r: -image.scores[r])
        for r in ranked:
            near = [(image.errors[r, g], g) for g in free if image.errors[r, g] < threshold]
            if near:
                truth = min(near)[1]
                free.remove(truth)
                if image.counts[truth]:
                    listed.append((image.scores[r], True))
            else:
                listed.append((image.scores[r], False))
    if required == 0:
        return None
    listed.sort(key=lambda entry: -entry[0])
    points = []
    for k in range(1, len(listed) + 1):
        hits = sum(right for _, right in listed[:k])
        points.append((hits / required, hits / k))
    total = 0.0
    for recall in np.linspace(0, 1, 101):
        total += max((p for r, p in points if r >= recall), default=0.0)
    return total / 101


def random_images(rng: np.random.Generator, count: int = 4) -> list[ImageErrors]:
    """Errors and scores of few values: ties are the rule, and so are errors that equal the threshold."""
    return [
        ImageErrors(rng.integers(0, 9, (r, i)) / 4, rng.integers(0, 5, r) / 4, rng.random(i) < 0.7)
        for r, i in rng.integers(0, 7, (count, 2))
    ]


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.25, 1.0, 1.5, np.inf]))
def test_precision_is_that_of_the_slow_rule(seed, threshold):
    images = random_images(np.random.default_rng(seed))
    expected = slow_precision(images, threshold)
    got = coco_precision(images, threshold)
    assert got == (None if expected is None else pytest.approx(expected, abs=1e-12))


def test_the_higher_score_takes_the_pose_even_if_another_result_is_nearer():
    errors = np.array([[0.9, 9], [0.1, 9]])
    assert match_greedily(errors, np.array([0.8, 0.7]), 1.0).tolist() == [0, -1]
    assert match_greedily(errors, np.array([0.7, 0.8]), 1.0).tolist() == [-1, 0]
    # A result whose nearest pose is taken gets the next one.
    assert match_greedily(np.array([[0.1, 9], [0.2, 0.5]]), np.array([2.0, 1]), 1.0).tolist() == [0, 1]


def test_an_error_that_equals_the_threshold_is_too_large():
    assert match_greedily(np.array([[0.5]]), np.ones(1), 0.5).tolist() == [-1]
    assert match_greedily(np.array([[0.5]]), np.ones(1), np.nextafter(0.5, 1)).tolist() == [0]


def test_what_hardly_shows_is_neither_required_nor_wrong():
    # One visible pose, found second; the first result is on the hidden one and counts as nothing.
    image = ImageErrors(np.array([[9, 0.1], [0.1, 9]]), np.array([0.9, 0.8]), np.array([True, False]))
    assert coco_precision([image], 1.0) == 1.0
    # A second result on the hidden pose has nothing left to match and is wrong: precision 1/2 at recall 1.
    twice = ImageErrors(np.array([[9, 0.1], [9, 0.1], [0.1, 9]]), np.array([0.9, 0.85, 0.8]), image.counts)
    assert coco_precision([twice], 1.0) == 0.5
    hidden = ImageErrors(image.errors[:, 1:], image.scores, image.counts[1:])
    assert coco_precision([hidden], 1.0) is None


def test_the_interpolation_by_hand():
    # Right, wrong, right of three required. Precision 1, 1/2, 2/3 at recall 1/3, 1/3, 2/3.
    # Recalls 0.00 .. 0.33 (34 of them) have 1, 0.34 .. 0.66 (33) have 2/3, the other 34 have 0: 56 / 101.
    assert interpolated_precision(np.array([True, False, True]), 3) == pytest.approx((34 + 33 * 2 / 3) / 101)
    assert interpolated_precision(np.array([True]), 1) == 1.0
    assert interpolated_precision(np.array([False, True]), 1) == pytest.approx(0.5)
    assert interpolated_precision(np.zeros(0, dtype=bool), 5) == 0.0


def test_the_recall_points_are_the_published_doubles():
    # linspace's point 35 is 0.35000000000000003, so 7 of 20 reach 0.00 .. 0.34 only: 35 points and not 36.
    assert interpolated_precision(np.ones(7, dtype=bool), 20) == pytest.approx(35 / 101)


def test_images_are_pooled():
    found = ImageErrors(np.array([[0.1]]), np.array([0.5]), np.array([True]))
    stray = ImageErrors(np.array([[9.0]]), np.array([0.9]), np.array([True]))
    # The stray comes first: precision 1/2 at recall 1/2, nothing beyond: 51 of 101 points.
    assert coco_precision([found, stray], 1.0) == pytest.approx(51 / 101 / 2)
    nothing = ImageErrors(np.zeros((0, 2)), np.zeros(0), np.ones(2, dtype=bool))
    assert coco_precision([nothing], 1.0) == 0.0


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0, 2.5), st.floats(0, 2.5))
def test_precision_and_found_poses_grow_with_the_threshold(seed, one, other):
    # A larger threshold appends choices to a result's list and reorders none: whoever is pushed out takes a pose
    # that was free or ends the chain, so no pose that was found is lost, at any score. Recall and precision grow at
    # every score, and the interpolated figure with them. (Bregier's AP is not monotone: test_score_properties.py.)
    images = random_images(np.random.default_rng(seed))
    low, high = sorted((one, other))
    for image in images:
        few, many = (match_greedily(image.errors, image.scores, t) for t in (low, high))
        assert set(few.tolist()) - {-1} <= set(many.tolist())
    worse, better = (coco_precision(images, t) for t in (low, high))
    assert worse is None or worse <= better + 1e-12
