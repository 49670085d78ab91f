"""The cell file: what is fixed about a cell, its camera and its bin, in one JSON file.

``{"camera": {"fx": .., "fy": .., "cx": .., "cy": .., "depth_scale": 0.0001}, "bin": {"camera_from_bin": [[..], ..],
"size": [0.36, 0.28, 0.16], "margin": 0.002}}``; both parts are optional.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Collection
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from attentionvote.inference.errors import InputError
from attentionvote.inference.preparation import Crop
from attentionvote.inference.scans.depth_files import CameraIntrinsics

_MOST_BYTES = 64 * 1024


@dataclass(frozen=True)
class Cell:
    """A cell's camera, for depth images, and bin, which is cropped to; None where the file says nothing."""

    camera: CameraIntrinsics | None = None
    crop: Crop | None = None


def read_cell(path: Path | str) -> Cell:
    """The cell that a file describes.

    Raises:
        InputError: with one sentence, when the file is missing, no JSON, or says something impossible.
    """
    return parse_cell(cell_bytes(path))


def cell_bytes(path: Path | str) -> bytes:
    """The content of a cell file, checked.

    Raises:
        InputError: with one sentence, when the file is missing, no JSON, or says something impossible.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"cell file {path} cannot be read: {error.strerror}") from error
    if len(content) > _MOST_BYTES:
        raise InputError(f"cell file {path} must have at most {_MOST_BYTES} bytes, got more")
    try:
        parse_cell(content)
    except InputError as error:
        raise InputError(f"cell file {path}: {error}") from error
    return content


def parse_cell(content: bytes) -> Cell:
    """The cell that the content of a cell file describes.

    Raises:
        InputError: with one sentence.
    """
    try:
        described = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"it must be JSON, got a text that is none ({error})") from error
    _check_keys("the cell", described, ("camera", "bin"), ())
    camera = crop = None
    if "camera" in described:
        names = [f.name for f in fields(CameraIntrinsics)]
        needed = [f.name for f in fields(CameraIntrinsics) if f.default is MISSING]
        _check_keys("camera", described["camera"], names, needed)
        camera = CameraIntrinsics(**described["camera"])
    if "bin" in described:
        _check_keys("bin", described["bin"], ("camera_from_bin", "size", "margin"), ("camera_from_bin", "size"))
        crop = Crop(**described["bin"])
    return Cell(camera, crop)


def _check_keys(what: str, value: Any, known: Collection[str], needed: Collection[str]) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{what} must be a JSON object with {', '.join(known)}, got {type(value).__name__}")
    for key in value:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise InputError(f"{what} must have the keys {', '.join(known)}; got {key[:60]!r}, did you mean {near!r}?")
    for key in needed:
        if key not in value:
            raise InputError(f"{what} must have {key}, but it is missing")
