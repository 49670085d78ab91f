"""Figures that no camera has, at the very edge of what is let through."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.camera_figures import check_depth_coding, check_focal_lengths, check_principal_point


@given(st.floats(1, 175), st.integers(2, 20_000))
def test_a_focal_length_is_judged_by_its_field_of_view(degrees: float, size: int) -> None:
    focal = size / 2 / math.tan(math.radians(degrees / 2))
    if 1.5001 < degrees < 169.999:
        check_focal_lengths(focal, focal, size, size)
    elif not 1.4999 < degrees < 170.001:
        word = "millimetres" if degrees > 100 else "micrometres"
        with pytest.raises(InputError, match=f"camera fx must be at .* pixels, got .*: are these .*{word}"):
            check_focal_lengths(focal, focal, size, size)


@pytest.mark.parametrize(("focal", "right"), [(16, False), (20, True), (500_000, True), (500_001, False)])
def test_without_a_size_the_bounds_are_wide(focal: float, right: bool) -> None:
    if right:
        check_focal_lengths(focal, focal, None, None)
    else:
        with pytest.raises(InputError, match="camera fx must be at"):
            check_focal_lengths(focal, focal, None, None)


@given(st.floats(0.2, 5))
def test_focal_lengths_are_alike(ratio: float) -> None:
    if 0.501 < ratio < 1.999:
        check_focal_lengths(1000 * ratio, 1000, None, None)
    elif not 0.499 < ratio < 2.001:
        with pytest.raises(
            InputError, match=r"camera fx and fy must be alike, within a factor of 2, got .* exchanged\?"
        ):
            check_focal_lengths(1000 * ratio, 1000, None, None)


@pytest.mark.parametrize(("cx", "right"), [(-640, True), (-641, False), (1280, True), (1281, False)])
def test_a_principal_point_lies_near_the_image(cx: float, right: bool) -> None:
    if right:
        check_principal_point(cx, 0, 640, None)
    else:
        with pytest.raises(
            InputError, match=r"camera cx must lie between -640 and 1280 pixels, got .*: is it of another"
        ):
            check_principal_point(cx, 0, 640, None)


@pytest.mark.parametrize("scale", [1e-6, 0.001, 0.1])
def test_usual_depths_are_let_through(scale: float) -> None:
    check_depth_coding(scale, 0)
    check_depth_coding(scale, 20)


@pytest.mark.parametrize(
    ("scale", "offset", "message"),
    [
        (
            1,
            0,
            r"depth_scale must be 1e-06 to 0\.1 metres per count, got 1: .* it is 0\.001; was 1 / depth_scale given",
        ),
        (1000, 0, "got 1000: for counts of a millimetre"),
        (9e-7, 0, "got 9e-07"),
        (0.001, -0.1, "depth_offset must be 0 to 20 metres, got -0.1"),
        (0.001, 800, r"depth_offset must be 0 to 20 metres, got 800: are these millimetres\? divide by 1000"),
    ],
)
def test_impossible_depths_are_refused(scale: float, offset: float, message: str) -> None:
    with pytest.raises(InputError, match=f"^camera .*{message}"):
        check_depth_coding(scale, offset)
