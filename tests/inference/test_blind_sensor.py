"""A sensor that sees nothing is not an empty bin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.inference.blind_sensor import BlindSensor, check_sight
from attentionvote.inference.scans.depth_files import CameraIntrinsics

# A bin of 0.3 x 0.2 x 0.1 m, its floor 0.85 m straight below the camera.
BIN = transform(rotation_about([1, 0, 0], np.pi), [0, 0, 0.85]), np.array([0.3, 0.2, 0.1])
CAMERA = CameraIntrinsics(300.0, 300.0, 159.5, 119.5, width=320, height=240)


def floor(count: int, seed: int = 0) -> NDArray[np.float32]:
    """Measured points of the bin's floor, which no crop leaves."""
    rng = np.random.default_rng(seed)
    return np.c_[rng.uniform(-0.149, 0.149, count), rng.uniform(-0.099, 0.099, count), np.full(count, 0.85)].astype(
        np.float32
    )


def test_the_floor_of_an_empty_bin_is_sight_enough(make_card: Callable[..., ModelCard]) -> None:
    card = make_card()  # its density is 2000
    check_sight(floor(400), 0, BIN, card, None)
    with pytest.raises(
        BlindSensor, match=r"^399 points were measured where the bin is, at least 400 are to be"
    ) as told:
        check_sight(floor(399), 0, BIN, card, None)
    assert told.value.used == 399
    assert "a fifth of 2000: the model was trained on scenes of that many points" in str(told.value)


def test_what_lies_beside_the_bin_is_no_sight_of_it(make_card: Callable[..., ModelCard]) -> None:
    beside = floor(3000) + np.float32([0.5, 0, 0])
    with pytest.raises(BlindSensor, match=r"^0 points were measured"):
        check_sight(beside, 0, BIN, make_card(), None)
    above = floor(3000) * np.float32(0.5)  # a heap higher than the bin, on the same rays
    check_sight(above, 0, BIN, make_card(), None)


def test_enough_points_inside_ask_nothing_more(make_card: Callable[..., ModelCard]) -> None:
    check_sight(np.zeros((0, 3), np.float32), 400, BIN, make_card(), None)


def test_a_coarse_camera_is_expected_to_see_what_its_pixels_can(make_card: Callable[..., ModelCard]) -> None:
    """The bin's silhouette by its nearest face, the rim at 0.75 m: 120 x 80 pixels, of which a fifth are 1920."""
    card = make_card(density=40_000)
    expected = 0.2 * (300 * 0.3 / 0.75) * (300 * 0.2 / 0.75)
    check_sight(floor(round(expected * 1.06)), 0, BIN, card, CAMERA)
    with pytest.raises(BlindSensor, match="so many pixels of the camera look at it"):
        check_sight(floor(round(expected * 0.94)), 0, BIN, card, CAMERA)
    with pytest.raises(BlindSensor, match="at least 8000 are to be expected"):
        check_sight(floor(3000), 0, BIN, card, None)


def test_a_finer_camera_asks_for_no_more_than_the_model(make_card: Callable[..., ModelCard]) -> None:
    fine = CameraIntrinsics(3000.0, 3000.0, 1599.5, 1199.5, width=3200, height=2400)
    check_sight(floor(400), 0, BIN, make_card(), fine)


def test_rays_through_a_tilted_bin_agree_with_points_in_it(make_card: Callable[..., ModelCard]) -> None:
    rng = np.random.default_rng(3)
    pose = transform(rotation_about([1, 0.3, 0.2], 2.8), [0.05, -0.02, 0.9])
    local = rng.uniform([-0.15, -0.1, 0], [0.15, 0.1, 0.1], (400, 3))
    inside = (local @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    check_sight(inside * np.float32(0.7), 0, (pose, BIN[1]), make_card(), None)  # on the rays, wherever they end
    with pytest.raises(BlindSensor):
        check_sight(inside[:399], 0, (pose, BIN[1]), make_card(), None)
