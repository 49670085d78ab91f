"""What was measured: missing measurements and strays are told from points, and all of them are counted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import InputError
from attentionvote.inference.measured_points import measured_points

MakeCard = Callable[..., ModelCard]
MakeCloud = Callable[..., NDArray[np.float32]]
LARGEST = float(np.finfo(np.float32).max)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0, 1]], r"must be an array \(P, 3\), or organised \(H, W, 3\), got list"),
        (np.zeros(3, np.float32), r"got \(3,\)"),
        (np.zeros((5, 4), np.float32), r"got \(5, 4\)"),
        (np.zeros((5, 5, 5, 3), np.float32), r"got \(5, 5, 5, 3\)"),
        (np.float32(1), r"got float32"),
        (np.zeros((5, 3), np.int32), "must be floating-point metres, got int32"),
        (np.zeros((5, 3), complex), "must be floating-point metres, got complex128"),
        (np.zeros((5, 3), object), "must be floating-point metres, got object"),
    ],
)
def test_an_array_that_is_no_cloud_is_one_sentence(make_card: MakeCard, points: NDArray, message: str) -> None:
    with pytest.raises(InputError, match=f"^points .*{message}"):
        measured_points(points, make_card())


def test_missing_measurements_are_counted_and_left_out(make_card: MakeCard) -> None:
    image = np.full((4, 5, 3), np.nan)
    image[1, 2], image[3, 4] = (0.1, 0.2, 0.8), (0.3, 0.4, 0.9)
    image[0, 0, 0] = 1.0  # one coordinate is not a point
    for cloud in (image, image.reshape(-1, 3), np.where(np.isnan(image), np.inf, image)):
        scan = measured_points(cloud, make_card())
        np.testing.assert_array_equal(scan.points, np.float32([[0.1, 0.2, 0.8], [0.3, 0.4, 0.9]]))
        assert (scan.total, scan.measured, scan.warnings) == (20, 2, ())


def test_the_origin_is_how_some_sensors_write_missing(make_card: MakeCard) -> None:
    scan = measured_points(np.float32([[0, 0, 0], [0, 0, 0.8], [-0.0, 0, 0]]), make_card())
    np.testing.assert_array_equal(scan.points, np.float32([[0, 0, 0.8]]))
    assert (scan.total, scan.measured) == (3, 1)


def test_the_limit_counts_measured_points(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    cloud = np.concatenate([make_cloud(100), np.full((900, 3), np.nan, np.float32)])
    assert measured_points(cloud, make_card(), most_points=100).measured == 100
    with pytest.raises(InputError, match="must be at most 99 measured ones, got 100: thin the cloud out"):
        measured_points(cloud, make_card(), most_points=99)


@pytest.mark.parametrize("far", [10.1, 1e4, 1e30, LARGEST])
def test_a_few_strays_are_left_out(make_card: MakeCard, make_cloud: MakeCloud, far: float) -> None:
    """Of 3,000 points 3 are a thousandth: beyond that there is a warning, beyond a fifth a refusal."""
    cloud = make_cloud(3000)
    for count, warned in ((3, False), (4, True), (600, True)):
        mixed = cloud.copy()
        mixed[::5][:count] = np.float32([far, -far, 0.8])
        scan = measured_points(mixed, make_card())
        assert len(scan.points) == 3000 - count
        assert scan.measured == 3000
        assert np.abs(scan.points).max() < 1
        assert scan.warnings == ((f"{count} points farther than 10 m were left out",) if warned else ())
    mixed[::5][:601] = np.float32([0, 0, far])
    mixed[1] = np.float32([0, 0, far])
    with pytest.raises(InputError, match=r"must lie within 10 m of the camera, .* but 601 of 3000 lie beyond"):
        measured_points(mixed, make_card())


def test_surroundings_are_no_strays(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    cloud = make_cloud(1000)
    cloud[::2] *= np.float32(11)  # a hall, nine metres away
    scan = measured_points(cloud, make_card())
    assert (len(scan.points), scan.warnings) == (1000, ())


def test_another_unit_is_named_not_called_stray(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    with pytest.raises(InputError, match="were millimetres sent"):
        measured_points(make_cloud() * np.float32(1000), make_card())


@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40))
def test_whatever_comes_out_is_finite_and_near(make_card: MakeCard, rows: list) -> None:
    cloud = np.array(rows, np.float32).reshape(-1, 3)
    try:
        scan = measured_points(cloud, make_card())
    except InputError:
        return
    assert np.isfinite(scan.points).all()
    assert scan.points.flags.c_contiguous
    assert (np.abs(scan.points) <= 10).all()
    finite = cloud[np.isfinite(cloud).all(axis=1)]
    assert scan.measured == np.count_nonzero(finite.any(axis=1))
    np.testing.assert_array_equal(scan.points, finite[finite.any(axis=1) & (np.abs(finite) <= 10).all(axis=1)])
