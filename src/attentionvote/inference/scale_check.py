"""Is a cloud in metres, in the camera frame, and of a scene like those the model was trained on?"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.inference.errors import InputError

REFUSED_FACTOR = 5.0
WARNED_FACTOR = 1.2
# Beside the bin a camera may see a hall, some ten times as far away; inches for metres, the nearest
# of the wrong units, are off by forty, of which the range of working distances hides less than a half.
WRONG_UNIT_FACTOR = 20.0
# A cloud in the world's frame is as large as a scene, but its height over the table is no distance from a camera, or it
# lies where no camera that looks along z sees it: 75 degrees beside the axis.
_LIKE_SIZE, _FLAT, _STEEPEST = 3.0, 6.0, 3.7
_LOOKED_AT = 5_000  # points are enough for percentiles
# What a cloud is multiplied by when it comes in another unit, and what to say.
_UNITS = (
    (1000.0, "were millimetres sent? divide by 1000"),
    (100.0, "were centimetres sent? divide by 100"),
    (39.37, "were inches sent? multiply by 0.0254"),
    (10.0, "is it ten times too far? divide it, or the depth_scale of a depth image, by 10"),
    (0.1, "is it ten times too near? multiply it, or the depth_scale of a depth image, by 10"),
    (0.001, "were metres divided by 1000 once too often? multiply by 1000"),
    (0.0254, "were metres taken for inches? divide by 0.0254"),
)


class _Scale(NamedTuple):
    """How a cloud compares with the model's scenes.

    Attributes:
        comparison: with the scenes that the model knows, in words.
        depth: factor by which its median depth lies beyond the farthest (above 1) or before the nearest (below 1).
        extent: its largest side as a multiple of a scene's.
        question: what may have happened.
        upright: whether it seems to be in a frame whose z points up: of the right size, but beside the camera's view.
    """

    comparison: str
    depth: float
    extent: float
    question: str
    upright: bool


def check_unit(cloud: NDArray[np.float32], card: ModelCard) -> None:
    """Refuse a cloud ``(P, 3)`` in another unit or frame, whatever else it shows beside the bin.

    Raises:
        InputError: when its depth is off by a factor of 20 and more, or most of it lies behind the camera.
    """
    if len(cloud):
        _refuse_depth(_scale(cloud, card), WRONG_UNIT_FACTOR)


def check_scene(cloud: NDArray[np.float32], card: ModelCard) -> tuple[str, ...]:
    """Warnings about a cloud ``(P, 3)`` of the bin's inside that is of an unusual scale.

    A small extent alone is nothing: bins become empty.

    Raises:
        InputError: when depth or extent is off by a factor of 5 and more: that is another scene than any known.
    """
    scale = _scale(cloud, card)
    _refuse_depth(scale, REFUSED_FACTOR)
    if scale.extent >= REFUSED_FACTOR:
        raise InputError(f"points must be of the bin only: {scale.comparison}: crop the cloud (`bin` in the cell file)")
    warnings = []
    if not 1 / WARNED_FACTOR < scale.depth < WARNED_FACTOR:
        warnings.append(f"the scene lies {'farther' if scale.depth > 1 else 'nearer'} than trained: {scale.comparison}")
    if scale.extent > WARNED_FACTOR:
        warnings.append(f"the scene is larger than trained: {scale.comparison}")
    return tuple(warnings)


def _refuse_depth(scale: _Scale, factor: float) -> None:
    if scale.upright:
        raise InputError(
            f"points must lie before the camera, in its frame (x right, y down, z forward), but {scale.comparison}: "
            "the cloud seems to be in a robot's or the world's frame with z up, "
            "transform it by the inverse of the camera's pose"
        )
    if scale.depth <= 0:
        raise InputError(
            f"points must lie before the camera, in its frame (x right, y down, z forward), but {scale.comparison}: "
            "transform them into the camera frame, or turn y and z round when they come from OpenGL"
        )
    if not 1 / factor < scale.depth < factor:
        raise InputError(f"points must be metres: {scale.comparison}: {scale.question}")


def _scale(cloud: NDArray[np.float32], card: ModelCard) -> _Scale:
    """Percentiles, not extremes: single flying points say nothing about the unit."""
    # Not every n-th: in an organised cloud that may be a few columns.
    some = np.linspace(0, len(cloud) - 1, min(len(cloud), _LOOKED_AT)).astype(np.intp)
    axes = cloud[some].T.astype(np.float64, order="C")
    low, middle, high = np.percentile(axes, [1, 50, 99], axis=1)
    wide, deep = float((high - low)[:2].max()), float(middle[2])
    near, far = card.distance
    comparison = (
        f"the cloud is {wide:.4g} wide and {deep:.4g} deep, "
        f"the model knows scenes {card.extent:.3g} m wide at {near:.3g}..{far:.3g} m"
    )
    depth = deep / far if deep > far else deep / near if deep < near else 1.0
    extent = float((high - low).max()) / card.extent
    beside = math.hypot(middle[0], middle[1]) > _STEEPEST * abs(deep)
    upright = 1 / _LIKE_SIZE < extent < _LIKE_SIZE and (abs(deep) < near / _FLAT or beside)
    return _Scale(comparison, depth, extent, _question(deep / math.sqrt(near * far)), upright)


def _question(factor: float) -> str:
    """What may have happened when a cloud lies ``factor`` times too far away."""
    if factor > 0:
        unit, question = min(_UNITS, key=lambda entry: abs(math.log(factor / entry[0])))
        if abs(math.log(factor / unit)) < math.log(2.2):
            return question
    return "check the unit and the sensor's settings"
