"""The bin's inside: what a crop leaves, and bins that no cell has."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.geometry.pose import rotation_about, transform
from attentionvote.inference.crop import Crop
from attentionvote.inference.errors import InputError


def overhead(height: float = 0.85, size: tuple[float, float, float] = (0.3, 0.2, 0.1), margin: float = 0.002) -> Crop:
    """A bin straight below a camera that looks down, its z towards the camera."""
    return Crop(transform(rotation_about([1, 0, 0], np.pi), [0, 0, height]), np.array(size), margin)


def test_a_crop_keeps_what_lies_between_the_walls_above_the_floor() -> None:
    crop = overhead(margin=0.01)
    # In the camera the bin's floor is at 0.85 m, its rim 0.1 m nearer; x keeps its direction, y turns round.
    asked = {
        (0.0, 0.0, 0.80): True,
        (0.139, 0.0, 0.80): True,
        (0.141, 0.0, 0.80): False,
        (0.0, -0.089, 0.80): True,
        (0.0, 0.091, 0.80): False,
        (0.0, 0.0, 0.839): True,
        (0.0, 0.0, 0.841): False,
        (0.0, 0.0, 0.751): True,
        (0.0, 0.0, 0.749): False,
        (0.0, 0.0, 0.95): False,
    }
    np.testing.assert_array_equal(crop.inside(np.float32(list(asked))), list(asked.values()))


@given(st.integers(0, 2**32 - 1))
def test_a_crop_moves_with_the_bin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rotation_about(rng.normal(size=3), rng.uniform(0, 6))
    # The camera is anywhere above the opening, whichever way it looks.
    camera = np.array([*rng.normal(size=2), rng.uniform(0.11, 2)])
    moved = transform(turn, -turn @ camera)
    there = Crop(moved, np.array([0.3, 0.2, 0.1]))
    points = rng.uniform(-0.2, 0.2, (200, 3)).astype(np.float32)
    edge = np.abs(np.abs(points) - [0.148, 0.098, 0.1]).min(axis=1) < 1e-5
    edge |= np.abs(points[:, 2] - 0.002) < 1e-5
    expected = (np.abs(points[:, 0]) <= 0.148) & (np.abs(points[:, 1]) <= 0.098)
    expected &= (points[:, 2] >= 0.002) & (points[:, 2] <= 0.1)
    seen = there.inside((points @ turn.T + moved[:3, 3]).astype(np.float32))
    np.testing.assert_array_equal(seen[~edge], expected[~edge])


def test_a_bin_whose_opening_does_not_face_the_camera_is_refused() -> None:
    upside_down = transform(np.eye(3), [0, 0, 0.8])  # z points away from the camera
    with pytest.raises(
        InputError,
        match=r"bin camera_from_bin must have the camera above the opening \(0.1 m over the floor, z up\), "
        r"got it at -0.8 m: is the bin's frame upside down, or is this bin_from_camera\? turn it, or invert the matrix",
    ):
        Crop(upside_down, np.array([0.3, 0.2, 0.1]))
    turned = transform(rotation_about([1, 0, 0], np.pi), [0, 0, 0.8])
    Crop(turned, np.array([0.3, 0.2, 0.79]))
    with pytest.raises(InputError, match=r"above the opening \(0.8001 m"):
        Crop(turned, np.array([0.3, 0.2, 0.8001]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_from_bin": np.eye(3)}, r"camera_from_bin must be \(4, 4\) finite numbers, got shape \(3, 3\)"),
        ({"camera_from_bin": np.full((4, 4), np.nan)}, "must be .* finite numbers"),
        ({"camera_from_bin": [["a"] * 4] * 4}, "numbers, got something else"),
        ({"camera_from_bin": [[1, 2], [3]]}, "numbers, got something else"),
        ({"camera_from_bin": np.eye(4) * 2}, "must be a rigid transform"),
        ({"camera_from_bin": np.diag([1.0, 1, -1, 1])}, "must be a rigid transform.* mirrored"),
        ({"camera_from_bin": transform(np.eye(3), [0, 0, 1]).T}, "must be a rigid transform.* transposed"),
        ({"camera_from_bin": transform(np.eye(3), [0, 0, 850])}, r"must be in metres, .* millimetres\? divide by 1000"),
        ({"size": [0.3, 0.2]}, r"size must be \(3,\) finite numbers"),
        ({"size": [0.3, 0.2, 0]}, "size must be three positive lengths"),
        ({"size": [300, 200, 100]}, r"at most 20, got \[300\.0, 200\.0, 100\.0\]: are these millimetres"),
        ({"margin": -0.001}, "margin must be metres from 0 to less than half the bin's smallest side"),
        ({"margin": 0.05}, r"smallest side \(0\.05\), got 0\.05"),
        ({"margin": "2 mm"}, "margin must be a number of metres, got '2 mm'"),
        ({"margin": float("nan")}, "margin must be metres from 0"),
    ],
)
def test_an_impossible_bin_is_one_sentence(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=f"^bin .*{message}"):
        Crop(**({"camera_from_bin": np.eye(4), "size": [0.3, 0.2, 0.1]} | changes))
