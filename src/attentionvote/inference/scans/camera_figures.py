"""Figures of a camera that no camera has, and what they probably are instead."""

from __future__ import annotations

import math

from attentionvote.inference.errors import InputError

_NARROWEST, _WIDEST = 1.5, 170.0  # degrees of view across an image: a long lens, a fisheye made straight
_SHORTEST, _LONGEST = 20.0, 500_000.0  # pixels, where the image's size is not known
_RATIO = 2.0
_FARTHEST_CENTER = 1e5  # pixels, where the image's size is not known
_FINEST, _COARSEST = 1e-6, 0.1  # metres per count
_FARTHEST = 20.0  # metres


def check_focal_lengths(fx: float, fy: float, width: int | None, height: int | None) -> None:
    """Refuse focal lengths (pixels) of an impossible field of view, or far from each other.

    Args:
        fx, fy: focal lengths, pixels.
        width, height: of the image, pixels; None: unknown.

    Raises:
        InputError: with what it probably is.
    """
    for name, focal, size in (("fx", fx, width), ("fy", fy, height)):
        shortest, longest = _SHORTEST, _LONGEST
        if size is not None:
            shortest = size / 2 / math.tan(math.radians(_WIDEST / 2))
            longest = size / 2 / math.tan(math.radians(_NARROWEST / 2))
        if focal < shortest:
            raise InputError(
                f"camera {name} must be at least {shortest:.4g} pixels, got {focal:g}: are these the lens's "
                "millimetres? divide by the size of a pixel in millimetres"
            )
        if focal > longest:
            raise InputError(
                f"camera {name} must be at most {longest:.4g} pixels, got {focal:g}: are these micrometres, or is "
                "it of another image size? take it from the sensor's calibration"
            )
    if not 1 / _RATIO <= fx / fy <= _RATIO:
        raise InputError(
            f"camera fx and fy must be alike, within a factor of {_RATIO:g}, got {fx:g} and {fy:g}: "
            "is one of another image size, or are cx and fy exchanged?"
        )


def check_principal_point(cx: float, cy: float, width: int | None, height: int | None) -> None:
    """Refuse a principal point (pixels) more than one image size outside the image.

    Args:
        cx, cy: principal point, pixels.
        width, height: of the image, pixels; None: unknown.

    Raises:
        InputError: with what it probably is.
    """
    for name, center, size in (("cx", cx, width), ("cy", cy, height)):
        least, most = (-_FARTHEST_CENTER, _FARTHEST_CENTER) if size is None else (-float(size), 2.0 * size)
        if not least <= center <= most:
            raise InputError(
                f"camera {name} must lie between {least:g} and {most:g} pixels, got {center:g}: "
                "is it of another image size, or exchanged with a focal length?"
            )


def check_depth_coding(scale: float, offset: float) -> None:
    """Refuse metres per count and metres at count 0 that no depth image has.

    Args:
        scale: metres per count.
        offset: metres at count 0.

    Raises:
        InputError: with what it probably is.
    """
    if not _FINEST <= scale <= _COARSEST:
        raise InputError(
            f"camera depth_scale must be {_FINEST:g} to {_COARSEST:g} metres per count, got {scale:g}: "
            "for counts of a millimetre it is 0.001; was 1 / depth_scale given, or millimetres per count?"
        )
    if not 0 <= offset <= _FARTHEST:
        raise InputError(
            f"camera depth_offset must be 0 to {_FARTHEST:g} metres, got {offset:g}: "
            "are these millimetres? divide by 1000"
        )
