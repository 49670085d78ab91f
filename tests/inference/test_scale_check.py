"""Wrong units and frames are refused with the likely reason; scenes that are merely unusual are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import InputError
from attentionvote.inference.scale_check import check_scene, check_unit

MakeCard = Callable[..., ModelCard]
MakeCloud = Callable[..., NDArray[np.float32]]


def test_a_scene_like_the_trained_ones_is_fine(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    check_unit(make_cloud(), make_card())
    assert check_scene(make_cloud(), make_card()) == ()


@pytest.mark.parametrize(
    ("factor", "question"),
    [
        (1000, r"were millimetres sent\? divide by 1000"),
        (100, r"were centimetres sent\? divide by 100"),
        (39.37, r"were inches sent\? multiply by 0\.0254"),
        (0.001, r"were metres divided by 1000 once too often\? multiply by 1000"),
        (0.0254, r"were metres taken for inches\? divide by 0\.0254"),
        (10, r"is it ten times too far\? divide it, or the depth_scale of a depth image, by 10"),
        (0.1, r"is it ten times too near\? multiply it, or the depth_scale of a depth image, by 10"),
        (1e7, "check the unit and the sensor's settings"),
    ],
)
def test_a_wrong_unit_is_named(make_card: MakeCard, make_cloud: MakeCloud, factor: float, question: str) -> None:
    cloud = make_cloud() * np.float32(factor)
    for check in (check_unit, check_scene) if not 0.05 < factor < 20 else (check_scene,):
        with pytest.raises(InputError, match=f"points must be metres: the cloud is .*: {question}$"):
            check(cloud, make_card())


def test_the_sentence_names_both_scales(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    message = (
        r"the cloud is 19[0-9](\.\d)? wide and 80[0-9](\.\d)? deep, the model knows scenes 0\.43 m wide at 0\.6\.\.1 m"
    )
    with pytest.raises(InputError, match=message):
        check_unit(make_cloud() * np.float32(1000), make_card())


@given(st.floats(0.21, 4.9))
def test_less_than_a_factor_of_five_is_not_refused(make_card: MakeCard, make_cloud: MakeCloud, factor: float) -> None:
    cloud = make_cloud() * np.float32(factor)
    check_unit(cloud, make_card())
    warnings = check_scene(cloud, make_card())
    _, _, depth = np.median(cloud, axis=0)
    wide = np.ptp(cloud[:, 0])
    if 0.51 < depth < 1.19 and wide < 1.19 * 0.43:
        assert not warnings
    elif not (0.49 < depth < 1.21 and wide < 1.25 * 0.43):
        assert warnings


@pytest.mark.parametrize(("depth", "refused"), [(4.9, False), (5.2, True), (0.6 / 4.8, False), (0.6 / 5.2, True)])
def test_a_factor_of_five_is_refused(make_card: MakeCard, make_cloud: MakeCloud, depth: float, refused: bool) -> None:
    cloud = make_cloud(center=(0, 0, depth))
    check_unit(cloud, make_card())
    if refused:
        with pytest.raises(InputError, match="points must be metres"):
            check_scene(cloud, make_card())
    else:
        assert len(check_scene(cloud, make_card())) == 1


def test_an_unusual_scene_is_warned_about_in_words(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    far, near = make_cloud(center=(0, 0, 2.0)), make_cloud(center=(0, 0, 0.3))
    assert "lies farther than trained: the cloud is" in check_scene(far, make_card())[0]
    assert "lies nearer than trained" in check_scene(near, make_card())[0]
    wide = make_cloud() * np.float32([4, 4, 1])
    assert "is larger than trained" in check_scene(wide, make_card())[0]


def test_a_cloud_far_larger_than_the_bin_asks_for_a_crop(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    wide = make_cloud() * np.float32([20, 20, 1])
    with pytest.raises(InputError, match=r"points must be of the bin only: .* crop the cloud"):
        check_scene(wide, make_card())
    check_unit(wide, make_card())  # before a crop that is nobody's fault


def test_a_hall_beside_the_bin_is_no_wrong_unit(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    hall = make_cloud(center=(0, 0, 15.0)) * np.float32([30, 30, 1])
    check_unit(np.concatenate([make_cloud(500), hall]), make_card())


def test_one_part_left_in_the_bin_is_nothing_unusual(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    assert check_scene(make_cloud() * np.float32([0.05, 0.05, 1]), make_card()) == ()


def test_a_few_flying_points_say_nothing(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    flying = np.concatenate([make_cloud(), np.float32([[50, 50, 900]] * 20)])
    assert check_scene(flying, make_card()) == ()


def test_another_frame_is_told_from_another_unit(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    with pytest.raises(
        InputError, match=r"points must lie before the camera.* turn y and z round when they come from OpenGL"
    ):
        check_unit(make_cloud() * np.float32([1, -1, -1]), make_card())


@pytest.mark.parametrize(
    "center",
    [(0, 0, 0), (0, 0, 0.05), (0.9, -0.3, -0.04), (-1.2, 0.4, 0.09), (3.0, 0, 0.75), (0, -3.2, -0.75)],
)
def test_a_cloud_of_a_robots_frame_is_told_from_another_unit(
    make_card: MakeCard, make_cloud: MakeCloud, center: tuple[float, float, float]
) -> None:
    cloud = make_cloud(center=center)
    for check in (check_unit, check_scene):
        with pytest.raises(
            InputError,
            match=r"points must lie before the camera, in its frame .*: the cloud seems to be in a robot's or the "
            r"world's frame with z up, transform it by the inverse of the camera's pose$",
        ):
            check(cloud, make_card())


def test_no_points_have_no_scale(make_card: MakeCard) -> None:
    check_unit(np.zeros((0, 3), np.float32), make_card())


def test_a_large_cloud_is_sampled_and_judged_alike(make_card: MakeCard, make_cloud: MakeCloud) -> None:
    with pytest.raises(InputError, match="millimetres"):
        check_unit(make_cloud(200_000) * np.float32(1000), make_card())
    assert check_scene(make_cloud(200_000), make_card()) == ()
