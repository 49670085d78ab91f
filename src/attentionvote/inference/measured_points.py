"""The measured points of a cloud: its shape checked, missing measurements and strays left out and counted."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import InputError
from attentionvote.inference.scale_check import check_unit
from attentionvote.inference.scans.limits import MOST_POINTS

# Beyond ten times the farthest scene lies no hall around a bin, only what a sensor invents or another unit.
STRAY_FACTOR = 10.0
_WARNED_SHARE, _REFUSED_SHARE = 0.001, 0.2


class MeasuredPoints(NamedTuple):
    """What a sensor measured.

    Attributes:
        points: ``(P, 3)`` float32 metres, camera frame, all finite.
        total: places of the cloud, missing measurements included.
        measured: places with a measurement, strays included.
        warnings: sentences about what was left out.
    """

    points: NDArray[np.float32]
    total: int
    measured: int
    warnings: tuple[str, ...]


def measured_points(points: NDArray[Any], card: ModelCard, most_points: int = MOST_POINTS) -> MeasuredPoints:
    """The points of a cloud that were measured and can belong to a scene of the model.

    Args:
        points: ``(P, 3)``, or organised ``(H, W, 3)``. A point with a coordinate that is not finite is a missing
            measurement, and so is one exactly at the origin, where the camera is.
        card: of the model; what lies farther away than ten times its farthest ``distance`` is a stray.
        most_points: that may be measured.

    Raises:
        InputError: on another shape or type, too many points, or when more than a fifth of them are strays.
    """
    if not isinstance(points, np.ndarray) or points.ndim not in (2, 3) or points.shape[-1] != 3:
        shape = points.shape if isinstance(points, np.ndarray) else type(points).__name__
        raise InputError(f"points must be an array (P, 3), or organised (H, W, 3), got {shape}")
    if points.dtype.kind != "f":
        raise InputError(
            f"points must be floating-point metres, got {points.dtype}: divide counts by their scale first"
        )
    flat = points.reshape(-1, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        cloud = flat.astype(np.float32, copy=False)
        # Column by column: a sum over three columns takes a tenth of the time of a test of rows, and no copy.
        size = np.abs(cloud[:, 0]) + np.abs(cloud[:, 1]) + np.abs(cloud[:, 2])
    there = (size > 0) & np.isfinite(size)
    if not there.all():
        overflown = np.isinf(size)
        if overflown.any():  # three finite numbers whose sum is none: strays, but measured
            there |= overflown & np.isfinite(cloud).all(axis=1)
        cloud, size = cloud[there], size[there]
    measured = len(cloud)
    if measured > most_points:
        raise InputError(f"points must be at most {most_points} measured ones, got {measured}: thin the cloud out")
    cloud, warnings = _without_strays(cloud, size, card)
    return MeasuredPoints(np.ascontiguousarray(cloud), len(flat), measured, warnings)


def _without_strays(
    cloud: NDArray[np.float32], size: NDArray[np.float32], card: ModelCard
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """The points that are no strays; ``size`` is the sum of each point's coordinates without their signs."""
    farthest = STRAY_FACTOR * card.distance[1]
    if not len(cloud) or size.max() <= farthest:  # hence no coordinate is beyond
        return cloud, ()
    near = (np.abs(cloud) <= farthest).all(axis=1)
    strays = len(cloud) - int(np.count_nonzero(near))
    if strays > _REFUSED_SHARE * len(cloud):
        check_unit(cloud, card)  # which knows the likelier reason
        raise InputError(
            f"points must lie within {farthest:.3g} m of the camera, ten times the model's farthest scene, but "
            f"{strays} of {len(cloud)} lie beyond: does the sensor write a number where nothing was? make it NaN"
        )
    sentence = f"{strays} points farther than {farthest:.3g} m were left out"
    return cloud[near], (sentence,) if strays > _WARNED_SHARE * len(cloud) else ()
