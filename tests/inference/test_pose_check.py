"""No pose leaves the cell that cannot be where something was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.inference.answer import Detection
from attentionvote.inference.pose_check import plausible


def detection(pose: NDArray[np.float64], part: str = "bracket") -> Detection:
    return Detection(pose, 0.9, part, 5.0)


def test_a_pose_is_as_near_to_a_point_as_its_part_is_large(make_card: Callable[..., ModelCard]) -> None:
    points = np.float32([[0, 0, 0.8], [0.02, 0, 0.8]])
    turn = rotation_about([0, 0, 1], 0.3)
    poses = [detection(transform(turn, [x, 0, 0.8])) for x in (0.0, 0.1199, 0.1201, -0.0999, -0.1001, 9.5e7)]
    remaining, withheld = plausible(poses, points, make_card())  # a part of 0.1 m
    assert remaining == (poses[0], poses[1], poses[3])
    assert withheld == 3


def test_the_middle_of_the_part_counts_not_its_origin(make_card: Callable[..., ModelCard]) -> None:
    card = make_card(part={"box": ((0.95, -0.02, -0.01), (1.05, 0.02, 0.01))})
    points = np.float32([[0, 0, 0.8]])
    far, near = detection(transform(np.eye(3), [0, 0, 0.8])), detection(transform(np.eye(3), [-1, 0, 0.8]))
    assert plausible([far, near], points, card) == ((near,), 1)


def test_each_part_has_its_own_size(make_card: Callable[..., ModelCard]) -> None:
    card = make_card()
    parts = (replace(card.part, name="bolt", diameter=0.01), replace(card.part, name="plate", diameter=0.3))
    card = make_card(classes=("bolt", "plate"), parts=parts)
    pose, points = transform(np.eye(3), [0.2, 0, 0.8]), np.float32([[0, 0, 0.8]])
    bolt, plate = detection(pose, "bolt"), detection(pose, "plate")
    assert plausible([bolt, plate], points, card) == ((plate,), 1)


def test_points_beyond_the_first_thousand_are_looked_at(make_card: Callable[..., ModelCard]) -> None:
    points = np.tile(np.float32([[0, 0, 0.8]]), (3000, 1))
    points[2500] = (0.5, 0, 0.8)
    assert plausible([detection(transform(np.eye(3), [0.55, 0, 0.8]))], points, make_card())[1] == 0


@pytest.mark.parametrize(
    "pose",
    [
        transform(np.diag([1.0, 1.0, -1.0]), [0, 0, 0.8]),
        transform(np.eye(3) * 1.001, [0, 0, 0.8]),
        transform(np.full((3, 3), np.nan), [0, 0, 0.8]),
        transform(np.eye(3), [0, np.inf, 0.8]),
    ],
)
def test_what_is_no_rigid_pose_is_withheld(make_card: Callable[..., ModelCard], pose: NDArray[np.float64]) -> None:
    assert plausible([detection(pose)], np.float32([[0, 0, 0.8]]), make_card()) == ((), 1)
