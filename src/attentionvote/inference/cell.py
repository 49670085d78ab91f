"""The cell file: what is fixed about a cell, its camera, its bin and the unit of its clouds, in one JSON file.

``{"camera": {"fx": .., "fy": .., "cx": .., "cy": .., "depth_scale": 0.0001}, "bin": {"camera_from_bin": [[..], ..],
"size": [0.36, 0.28, 0.16], "margin": 0.002}, "cloud": {"unit": "mm"}}``; all parts are optional.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.crop import Crop
from attentionvote.inference.errors import InputError, nearest
from attentionvote.inference.scans.depth_files import CameraIntrinsics
from attentionvote.inference.scans.limits import BLOCK_ROWS

_MOST_BYTES = 64 * 1024


# Units in a metre: dividing by them is exact where multiplying by 0.001 is not.
_UNITS_A_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "um": 1e6, "inch": 1 / 0.0254}


@dataclass(frozen=True)
class CloudUnit:
    """The unit of clouds that are read from files; arrays over the protocol are metres always.

    Args:
        unit: m, cm, mm, um or inch.

    Raises:
        InputError: when it is another one.
    """

    unit: str

    def __post_init__(self) -> None:
        if not isinstance(self.unit, str) or self.unit not in _UNITS_A_METRE:
            hint = nearest(str(self.unit).lower(), _UNITS_A_METRE, cutoff=0.0)
            raise InputError(
                f"cloud unit must be one of {', '.join(_UNITS_A_METRE)}, got {str(self.unit)[:20]!r}{hint}"
            )

    def metres(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points ``(..., 3)`` of this unit in metres, each coordinate rounded once; metres are returned as they are."""
        if self.unit == "m":
            return points
        scaled = np.empty(points.shape, np.float32)
        rows, target = points.reshape(-1, 3), scaled.reshape(-1, 3)
        for start in range(0, len(rows), BLOCK_ROWS):  # doubles of a whole frame would be twice its size
            block = rows[start : start + BLOCK_ROWS].astype(np.float64)
            target[start : start + BLOCK_ROWS] = block / _UNITS_A_METRE[self.unit]
        return scaled


@dataclass(frozen=True)
class Cell:
    """What is fixed about a cell.

    Attributes:
        camera: of depth images; None where the file says nothing.
        crop: the bin, which is cropped to; None where the file says nothing.
        cloud: unit of clouds from files; metres where the file says nothing.
    """

    camera: CameraIntrinsics | None = None
    crop: Crop | None = None
    cloud: CloudUnit = CloudUnit("m")


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
        described = json.loads(content, parse_int=_whole_number, object_pairs_hook=_without_twins)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"it must be JSON, got a text that is none ({error})") from error
    sections: dict[str, type[Any]] = {"camera": CameraIntrinsics, "bin": Crop, "cloud": CloudUnit}
    _check_keys("the cell", described, sections, ())
    values: dict[str, Any] = {}
    for section, kind in sections.items():
        if section in described:
            entries = fields(kind)
            needed = [entry.name for entry in entries if entry.default is MISSING]
            _check_keys(section, described[section], [entry.name for entry in entries], needed)
            values["crop" if section == "bin" else section] = kind(**described[section])
    return Cell(**values)


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; of a key that stands twice Python's reader would take the last one, silently."""
    described: dict[str, Any] = {}
    for key, value in pairs:
        if key in described:
            raise InputError(f"each key must stand once in its object, got {key[:60]!r} twice: remove one of them")
        described[key] = value
    return described


def _whole_number(digits: str) -> float:
    """A whole number; one that no double holds is infinite, which every field refuses."""
    return int(digits) if len(digits) < 20 else float(digits)


def _check_keys(what: str, value: Any, possible: Collection[str], needed: Collection[str]) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{what} must be a JSON object with {', '.join(possible)}, got {type(value).__name__}")
    for key in value:
        if key not in possible:
            hint = nearest(key, possible, cutoff=0.0)
            raise InputError(f"{what} must have the keys {', '.join(possible)}; got {key[:60]!r}{hint}")
    for key in needed:
        if key not in value:
            raise InputError(f"{what} must have {key}, but it is missing")
