"""The C point operators against their slow references, and both against hand-made cases."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry import native, sampling, sampling_reference

SEEDS = st.integers(0, 2**31)
# Lattice points make ties and borders; scattered ones do not.
LATTICE = st.booleans()


def cloud(seed: int, count: int, lattice: bool) -> np.ndarray:
    """Points in a decimetre cube, on a 2 cm lattice (with repeats) or anywhere."""
    rng = np.random.default_rng(seed)
    if lattice:
        return (rng.integers(0, 5, (count, 3)) * 0.02).astype(np.float32)
    return rng.uniform(0, 0.1, (count, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def _compiled() -> None:
    """Without the C library these tests would compare the references with themselves."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    assert native.load("attentionvote.geometry", "pointops.c") is not None


@given(SEEDS, st.integers(1, 300), LATTICE)
def test_farthest_point_order_equals_its_reference(seed: int, count: int, lattice: bool) -> None:
    points = cloud(seed, count, lattice)
    wanted = max(1, count // 2)
    order = sampling.farthest_point_order(points, wanted)
    np.testing.assert_array_equal(order, sampling_reference.farthest_point_order(points, wanted))


@given(SEEDS, st.integers(2, 200))
def test_a_shorter_farthest_point_order_is_a_prefix(seed: int, count: int) -> None:
    points = cloud(seed, count, False)
    full = sampling.farthest_point_order(points, count)
    np.testing.assert_array_equal(sampling.farthest_point_order(points, count // 2), full[: count // 2])
    assert sorted(full) == list(range(count))


def test_farthest_points_of_a_line_are_its_ends_and_then_its_middle() -> None:
    line = np.float32([[0.2, 0, 0], [0, 0, 0], [0.45, 0, 0], [1, 0, 0], [0.9, 0, 0]])
    np.testing.assert_array_equal(sampling.farthest_point_order(line, 3), [0, 3, 2])


@given(SEEDS, st.integers(1, 300), st.integers(0, 20), st.sampled_from([0.005, 0.02, 0.04, 0.5]), LATTICE)
def test_ball_query_equals_its_reference(seed: int, count: int, centers: int, radius: float, lattice: bool) -> None:
    points, middle = cloud(seed, count, lattice), cloud(seed + 1, centers, lattice)
    actual = sampling.ball_query(points, middle, radius, 8)
    for a, b in zip(actual, sampling_reference.ball_query(points, middle, radius, 8), strict=True):
        np.testing.assert_array_equal(a, b)


def test_balls_are_padded_with_their_first_index_and_empty_ones_with_zero() -> None:
    points = np.float32([[9, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    neighbors, found = sampling.ball_query(points, np.float32([[0, 0, 0], [5, 5, 5]]), 0.5, 4)
    np.testing.assert_array_equal(neighbors, [[1, 2, 1, 1], [0, 0, 0, 0]])
    np.testing.assert_array_equal(found, [2, 0])


@given(SEEDS, st.integers(1, 60), st.integers(0, 60), LATTICE)
def test_three_nearest_equals_its_reference(seed: int, sources: int, targets: int, lattice: bool) -> None:
    a, b = cloud(seed, sources, lattice), cloud(seed + 1, targets, lattice)
    index, distance = sampling.three_nearest(a, b)
    expected_index, expected_distance = sampling_reference.three_nearest(a, b)
    np.testing.assert_array_equal(index, expected_index)
    np.testing.assert_array_equal(distance, expected_distance)


def test_squares_that_overflow_are_farthest_and_never_inside() -> None:
    most = np.finfo(np.float32).max
    points = np.float32([[0, 0, 0], [1, 0, 0], [-most, 0, 0], [most, 0, 0], [0, most, 0]])
    np.testing.assert_array_equal(sampling.farthest_point_order(points, 5), [0, 2, 3, 4, 1])
    for radius, own in ((1.0, [2, 2, 1, 1, 1]), (float(most), [2, 2, 1, 1, 1]), (0.5, [1, 1, 1, 1, 1])):
        np.testing.assert_array_equal(sampling.ball_query(points, points, radius, 3)[1], own)
    index, distance = sampling.three_nearest(points, points[3:])
    np.testing.assert_array_equal(index, [[3, 0, 1], [4, 0, 1]])
    np.testing.assert_array_equal(distance, np.sqrt([[0, most, most]] * 2, dtype=np.float32))


POINTS = cloud(0, 5, False)
BROKEN = np.where(np.arange(15).reshape(5, 3) == 7, np.nan, POINTS)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sampling.farthest_point_order(POINTS, 6), r"count must lie in 1\.\.5 \(the number of points\), got 6"),
        (lambda: sampling.farthest_point_order(POINTS, 0), r"count must lie in 1\.\.5"),
        (
            lambda: sampling.farthest_point_order(POINTS[:0], 1),
            r"points must have shape \(P, 3\) with P >= 1, got \(0, 3\)",
        ),
        (lambda: sampling.farthest_point_order(BROKEN, 2), "points must be finite, got 1 with NaN or inf"),
        (lambda: sampling.ball_query(POINTS[:, :2], POINTS, 1.0, 2), r"points must have shape \(P, 3\)"),
        (lambda: sampling.ball_query(POINTS, BROKEN, 1.0, 2), "centers must be finite, got 1 with NaN or inf"),
        (lambda: sampling.ball_query(POINTS, POINTS, 0.0, 2), "radius must be a positive number of metres, got 0.0"),
        (lambda: sampling.ball_query(POINTS, POINTS, np.nan, 2), "radius must be a positive number of metres, got nan"),
        (lambda: sampling.ball_query(POINTS, POINTS, 1.0, 0), "count must be at least 1, got 0"),
        (lambda: sampling.three_nearest(POINTS[:0], POINTS), r"sources must have shape"),
    ],
)
def test_impossible_arguments_are_refused(call: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()  # type: ignore[operator]


def test_without_a_compiler_there_is_a_warning_and_the_reference(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    native.compiled.cache_clear()
    try:
        with pytest.warns(
            UserWarning, match=r"no C compiler found, pointops\.c is replaced by slow Python: install gcc"
        ):
            order = sampling.farthest_point_order(POINTS, 3)
        np.testing.assert_array_equal(order, sampling_reference.farthest_point_order(POINTS, 3))
    finally:
        native.compiled.cache_clear()
