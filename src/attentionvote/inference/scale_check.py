"""Is a cloud in metres, in the camera frame, and of a scene like those the model was trained on?"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import InputError

REFUSED_FACTOR = 5.0
WARNED_FACTOR = 1.2
_LOOKED_AT = 20_000  # points are enough for percentiles
# What a cloud is multiplied by when it comes in another unit, and what to say.
_UNITS = (
    (1000.0, "were millimetres sent? divide by 1000"),
    (100.0, "were centimetres sent? divide by 100"),
    (39.37, "were inches sent? multiply by 0.0254"),
    (0.001, "were metres divided by 1000 once too often? multiply by 1000"),
    (0.0254, "were metres taken for inches? divide by 0.0254"),
)


def check_scale(cloud: NDArray[np.float32], card: ModelCard, *, cropped: bool, crop_follows: bool) -> tuple[str, ...]:
    """Warnings about a cloud ``(P, 3)`` of an unusual scale.

    A wrong unit moves depth and extent alike; a scene that is merely seen from farther away, or a cloud with more
    than the bin in it, moves one of them, and less. A small extent alone is nothing: bins become empty.

    Args:
        cloud: measured points, metres.
        card: of the model.
        cropped: whether only the bin's inside is left.
        crop_follows: whether the rest of the room will be cropped away yet.

    Raises:
        InputError: when depth or extent is off by a factor of 5 and more, or the points lie behind the camera.
    """
    if not len(cloud):
        return ()
    some = cloud[:: max(1, len(cloud) // _LOOKED_AT)]
    low, middle, high = np.percentile(some.astype(np.float64), [1, 50, 99], axis=0)
    wide, depth = float((high - low)[:2].max()), float(middle[2])
    size = max(wide, float((high - low)[2]))
    near, far = card.distance
    told = (
        f"the cloud is {wide:.4g} wide and {depth:.4g} deep, "
        f"the model knows scenes {card.extent:.3g} m wide at {near:.3g}..{far:.3g} m"
    )
    if depth <= 0:
        raise InputError(
            f"points must lie before the camera, in its frame (x right, y down, z forward), but {told}: "
            "transform them into the camera frame, or turn y and z round when they come from OpenGL"
        )
    off = depth / far if depth > far else depth / near if depth < near else 1.0
    wider = size / card.extent
    if off >= REFUSED_FACTOR or off <= 1 / REFUSED_FACTOR:
        raise InputError(f"points must be metres: {told}: {_question(depth / math.sqrt(near * far))}")
    if crop_follows:
        return ()
    if wider >= REFUSED_FACTOR:
        raise InputError(f"points must be of the bin only: {told}: crop the cloud (`bin` in the cell file)")
    warnings = []
    if cropped and not 1 / WARNED_FACTOR < off < WARNED_FACTOR:
        warnings.append(f"the scene lies nearer or farther than trained: {told}")
    if cropped and wider > WARNED_FACTOR:
        warnings.append(f"the scene is larger than trained: {told}")
    return tuple(warnings)


def _question(factor: float) -> str:
    """What may have happened when a cloud is ``factor`` times too large."""
    unit, question = min(_UNITS, key=lambda entry: abs(math.log(factor / entry[0])))
    return question if abs(math.log(factor / unit)) < math.log(2.2) else "check the unit and the sensor's settings"
