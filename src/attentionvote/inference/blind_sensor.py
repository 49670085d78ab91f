"""The test for a sensor that does not see the bin: a blind one must not be taken for an empty bin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.geometry.pose import apply, inverse
from attentionvote.inference.scans.depth_files import CameraIntrinsics

# An empty bin is measured as well as a full one: its floor and walls are there.
LEAST_SHARE = 0.2
_SAMPLES = 64  # rays an axis of the image: enough for a share of a fifth


class BlindSensor(Exception):
    """Too little was measured of the bin to say anything about it.

    Attributes:
        used: points measured there.
    """

    def __init__(self, message: str, used: int) -> None:
        super().__init__(message)
        self.used = used


def check_sight(
    cloud: NDArray[np.float32],
    inside: int,
    bin_box: tuple[NDArray[np.float64], NDArray[np.float64]],
    card: ModelCard,
    camera: CameraIntrinsics | None,
) -> None:
    """Refuse to judge a bin of which less than a fifth was measured of what is to be expected.

    Expected are as many points as the camera has pixels that look at the bin, and no more than the card's ``density``,
    from which training measured its scenes.

    Args:
        cloud: ``(P, 3)`` measured points, camera frame.
        inside: how many of them lie in the bin; where they are enough, nothing else is computed.
        bin_box: ``camera_from_bin`` (bin frame: middle of the floor, z up) and the bin's inner size, metres.
        card: of the model.
        camera: of the cell, with the size of its images; None: the card alone decides.

    Raises:
        BlindSensor: with a sentence.
    """
    expected, source = float(card.density), "the model was trained on scenes of that many points"
    if camera is not None and camera.width is not None and camera.height is not None:
        pixels = _pixels_on_bin(camera, camera.width, camera.height, bin_box)
        if pixels < expected:
            expected, source = pixels, "so many pixels of the camera look at it"
    least = LEAST_SHARE * expected
    if inside >= least:
        return
    seen = int(np.count_nonzero(_looks_at_bin(cloud.astype(np.float64), bin_box)))
    if seen < least:
        raise BlindSensor(
            f"{seen} points were measured where the bin is, at least {least:.0f} are to be expected (a fifth of "
            f"{expected:.0f}: {source}): is the sensor covered, dirty or wrongly exposed, the cloud thinned out, or "
            "`bin` or `camera` of the cell file wrong?",
            seen,
        )


def _pixels_on_bin(
    camera: CameraIntrinsics, width: int, height: int, bin_box: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> float:
    """How many pixels of the camera's image look at the bin."""
    u, v = np.meshgrid(np.linspace(0, width - 1, _SAMPLES), np.linspace(0, height - 1, _SAMPLES))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    return float(_looks_at_bin(rays.reshape(-1, 3), bin_box).mean()) * width * height


def _looks_at_bin(
    rays: NDArray[np.float64], bin_box: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.bool_]:
    """Which rays ``(R, 3)`` from the camera pass through the bin, by the slabs between its faces."""
    bin_from_camera = inverse(bin_box[0])
    size = bin_box[1]
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    origin = bin_from_camera[:3, 3]
    direction = apply(bin_from_camera, rays) - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = (low - origin) / direction, (high - origin) / direction
    enters = np.nanmax(np.minimum(to_low, to_high), axis=1, initial=0.0)
    leaves = np.nanmin(np.maximum(to_low, to_high), axis=1, initial=np.inf)
    return enters <= leaves
