"""A camera's intrinsics from a file: fx, fy, cx, cy; cam_K (BOP); K or k (ROS CameraInfo); ROS's calibration YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from attentionvote.simulation.camera import Camera

_MATRICES = ("cam_K", "K", "k", "camera_matrix")
_SIZES = (("width", "image_width"), ("height", "image_height"))


def read_camera(path: Path) -> Camera:
    """The pinhole camera that a JSON or YAML file describes; of a file by image (BOP's scene_camera.json) the first.

    Distortion is not looked at: depth images are rectified, and their intrinsics are those of the projection matrix
    ``P`` (``p``) where a ROS CameraInfo has one.

    Raises:
        ValueError: with one sentence, when the file describes none.
        FileNotFoundError: when there is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"camera file {str(path)!r} does not exist")
    try:
        # JSON is YAML; `ros2 topic echo` ends a message with ---, and may print several.
        content = next(yaml.safe_load_all(path.read_text(encoding="utf-8")), None)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must be JSON or YAML, but it cannot be read") from error
    if isinstance(content, Mapping) and isinstance(content.get("camera"), Mapping):  # a cell's file
        content = content["camera"]
    if isinstance(content, Mapping) and content and all(isinstance(entry, Mapping) for entry in content.values()):
        content = next(iter(content.values()))
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} must have fx, fy, cx, cy or a matrix {', '.join(_MATRICES)}, got no names at all")
    for name in ("binning_x", "binning_y"):
        if content.get(name) not in (None, 0, 1):
            raise ValueError(
                f"{path} must be of the whole picture, got {name} {content[name]!r}: give fx, fy, cx, cy as binned"
            )
    focal = _focal_lengths(path, _rectified(content))
    size = [next((content[name] for name in names if name in content), None) for names in _SIZES]
    for (name, _), value, middle in zip(_SIZES, size, focal[2:], strict=True):
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{path} must have {name}, whole pixels, got {value!r}: add it, e.g. {round(2 * middle)}")
    width, height = size
    fx, fy, cx, cy = focal
    try:
        return Camera(width, height, fx, fy, cx, cy)  # type: ignore[arg-type]  # whole numbers, as checked
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _rectified(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """With the matrix ``K`` of the projection matrix, where one is given that is not empty."""
    for name in ("P", "p", "projection_matrix"):
        values = content.get(name)
        values = values.get("data") if isinstance(values, Mapping) else values
        try:
            matrix = np.array(values, dtype=np.float64).ravel()
        except (TypeError, ValueError):
            continue
        if matrix.shape == (12,) and matrix[0] > 0:
            return {"K": matrix.reshape(3, 4)[:, :3].ravel().tolist()}
    return content


def _focal_lengths(path: Path, content: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels."""
    name = next((name for name in _MATRICES if name in content), None)
    if name is None:
        missing = [key for key in ("fx", "fy", "cx", "cy") if key not in content]
        if missing:
            raise ValueError(f"{path} must have fx, fy, cx, cy or a matrix {', '.join(_MATRICES)}, got no {missing[0]}")
        values: Any = [content[key] for key in ("fx", "fy", "cx", "cy")]
    else:
        values = content[name]
        values = values.get("data") if isinstance(values, Mapping) else values
    try:
        numbers = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {name or 'fx, fy, cx, cy'} must be numbers, got {values!r:.60}") from error
    if name is not None:
        if numbers.shape != (9,) or np.abs(numbers[[1, 3, 6, 7]]).max() > 1e-9 or numbers[8] != 1:
            raise ValueError(f"{path}: {name} must be row by row fx 0 cx 0 fy cy 0 0 1, got {numbers.tolist()!r:.80}")
        numbers = numbers[[0, 4, 2, 5]]
    if not np.isfinite(numbers).all():
        raise ValueError(f"{path}: {name or 'fx, fy, cx, cy'} must be finite, got {numbers.tolist()}")
    fx, fy, cx, cy = map(float, numbers)
    return fx, fy, cx, cy
