"""The one reader of BOP's ``models_info.json``: for datasets, for the API and for ``make score``.

BOP's diameter is the largest vertex distance. Lengths are millimetres in the file and metres here. A symmetry is kept
twice: as the file has it, which BOP's own score expands, and as the nearest group of rotations (``bop_symmetry``).
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.bop_symmetry import Axes, nearest_group
from attentionvote.datasets.text_files import read_json
from attentionvote.geometry.symmetry import Symmetry

log = logging.getLogger("attentionvote.datasets")

MODELS_INFO = "models_info.json"
FOLDERS = ("models", "models_eval", "models_cad", "models_reconst")
LARGEST_FILE = 64 * 2**20  # bytes; a model with the most symmetries takes one and a half million
MOST_SYMMETRIES = 4096  # discrete ones times axes, of a model; each may become 315 matrices
# Millimetres: from the smallest part that `make part` takes, and beyond the largest.
SMALLEST, LARGEST = 1.0, 10_000.0
# The largest vertex distance is between the longest side of the box and its diagonal; other meshes of the same part,
# rounded ones and those with fewer vertices, differ by less than this factor.
SLACK = 2.0
# Of R R^T from I: three digits make 0.002, two make 0.02.
ROTATION_ERROR = 0.005
MOST_NUMBER = 1e9  # no length in millimetres and no direction needs more, nor is NaN or infinity less
DISCRETE, CONTINUOUS = "symmetries_discrete", "symmetries_continuous"


class BopModel(NamedTuple):
    """What the file says of one model.

    Attributes:
        diameter: metres.
        discrete: ``(K, 4, 4)`` symmetries as the file lists them, ``part_from_part``, metres.
        continuous: axis ``(3,)`` and a point ``(3,)`` on it, metres, of every axis of revolution, as the file has them.
        symmetry: the nearest group, about ``center``; None for a ball, which no ``Symmetry`` describes.
        center: ``(3,)`` metres, the point that no symmetry moves; of several the nearest to the model's origin.
    """

    diameter: float
    discrete: NDArray[np.float64]
    continuous: Axes
    symmetry: Symmetry | None
    center: NDArray[np.float64]


def read_models_info(path: Path) -> dict[int, BopModel]:
    """Every model of a ``models_info.json`` by its object id; symmetries that are slightly off are said in the log.

    Raises:
        ValueError: with one sentence naming the object and the rule, when the file is ambiguous or impossible.
    """
    return {number: _model(where, entry) for number, (where, entry) in _entries(path).items()}


def read_diameters(path: Path) -> dict[int, float]:
    """Diameters in metres by object id, where the symmetries do not matter.

    Raises:
        ValueError: as ``read_models_info``, but for the symmetries.
    """
    return {number: _diameter(where, entry) / 1000 for number, (where, entry) in _entries(path).items()}


def models_info_of(split: Path) -> Path | None:
    """The ``models_info.json`` beside a split's folder, or None."""
    for folder in FOLDERS:
        if (split.parent / folder / MODELS_INFO).is_file():
            return split.parent / folder / MODELS_INFO
    return None


def box_agrees(diameter: float, sizes: Sequence[float]) -> bool:
    """Whether a diameter and the three sides of a model's box can be of one part in one unit, with some slack."""
    return max(sizes) / SLACK <= diameter <= math.hypot(*sizes) * SLACK


def _entries(path: Path) -> dict[int, tuple[str, Mapping[str, Any]]]:
    """Every object's entry by its id, with the beginning of a sentence about it."""
    if path.is_file() and (size := path.stat().st_size) > LARGEST_FILE:
        raise ValueError(f"{path}: the file must have at most {LARGEST_FILE} bytes, got {size}")
    entries: dict[int, tuple[str, Mapping[str, Any]]] = {}
    content = read_json(path, dict)
    for key, entry in content.items():
        if not re.fullmatch("0|[1-9][0-9]*", key):
            number = str(int(key)) if key.isdecimal() else ""
            problem = f"write {number!r}" if number else "a model's entry belongs under its number"
            if number in content:
                problem = f"it is there beside {number!r}, which is the same object"
            raise ValueError(f"{path}: every key must be an object id without leading zeros, got {key!r}: {problem}")
        if not isinstance(entry, dict):
            raise ValueError(f"{path}: object {key} must be a JSON object with its diameter, got {entry!r:.60}")
        entries[int(key)] = f"{path}: object {key}", entry
    return entries


def _diameter(where: str, entry: Mapping[str, Any]) -> float:
    """Millimetres."""
    diameter = float(_numbers(where, entry, "diameter", 1)[0])
    if diameter <= 0:
        raise ValueError(f"{where} must have a positive diameter in millimetres, got {diameter:g}")
    keys = [f"{name}_{axis}" for name in ("min", "size") for axis in "xyz"]
    box = {key: float(_numbers(where, entry, key, 1)[0]) for key in keys if key in entry}
    sizes = [box[key] for key in keys[3:] if key in box]
    if min(sizes, default=0.0) < 0:
        raise ValueError(f"{where} must have a size_x, size_y and size_z of at least 0, got {min(sizes):g}")
    if len(sizes) == 3 and not box_agrees(diameter, sizes):
        raise ValueError(
            f"{where} must have a diameter, the largest vertex distance, between the longest side and the diagonal "
            f"of its box, {max(sizes):g} and {math.hypot(*sizes):g}, got {diameter:g}: are both in millimetres?"
        )
    if not SMALLEST <= diameter <= LARGEST:
        looks = "metres" if diameter < SMALLEST else "micrometres"
        raise ValueError(
            f"{where} must have a diameter in millimetres, {SMALLEST:g} to {LARGEST:g}, got {diameter:g}: looks like "
            f"{looks}"
        )
    return diameter


def _model(where: str, entry: Mapping[str, Any]) -> BopModel:
    diameter = _diameter(where, entry)
    for key in entry:
        if key.lower().startswith("symmetr") and key not in (DISCRETE, CONTINUOUS):
            raise ValueError(f"{where} must have its symmetries under {DISCRETE} and {CONTINUOUS}, got {key!r}")
    matrices = [_matrix(f"{where}: {DISCRETE}[{i}]", value) for i, value in enumerate(_list(where, entry, DISCRETE))]
    axes = [_axis(f"{where}: {CONTINUOUS}[{i}]", value) for i, value in enumerate(_list(where, entry, CONTINUOUS))]
    count = (1 + len(matrices)) * max(len(axes), 1)
    if count > MOST_SYMMETRIES:
        raise ValueError(f"{where} must have at most {MOST_SYMMETRIES} symmetries with the identity, got {count}")
    discrete = np.array(matrices).reshape(-1, 4, 4)
    group = nearest_group(where, discrete, axes, diameter)
    if remarks := group.remarks(diameter):
        log.warning(
            "%s: its symmetries are %s; %s are taken, and only BOP's score goes by the file's own, as the toolkit does",
            where, " and ".join(remarks), group.described,
        )  # fmt: skip
    discrete[:, :3, 3] /= 1000
    continuous = tuple((axis, offset / 1000) for axis, offset in axes)
    return BopModel(diameter / 1000, discrete, continuous, group.symmetry, group.center / 1000)


def _list(where: str, entry: Mapping[str, Any], key: str) -> list[Any]:
    value = entry.get(key, [])
    if not isinstance(value, list):
        raise ValueError(f"{where}: {key} must be a list, got {value!r:.60}")
    return value


def _matrix(where: str, value: Any) -> NDArray[np.float64]:
    """``(4, 4)``, millimetres."""
    matrix = _numbers(where, {"it": value}, "it", 16, "a 4x4 matrix row by row, 16 numbers").reshape(4, 4)
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        hint = ": looks like column by column" if np.abs(matrix[:, 3] - (0, 0, 0, 1)).max() < 1e-6 else ""
        raise ValueError(
            f"{where} must be a 4x4 matrix row by row with the last row 0 0 0 1, got {matrix[3].tolist()}{hint}"
        )
    rotation = matrix[:3, :3]
    spread, determinant = np.linalg.svd(rotation, compute_uv=False), float(np.linalg.det(rotation))
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > ROTATION_ERROR or determinant < 0:
        what = f"R R^T off from I by {error:.2g}"
        if np.ptp(spread) < ROTATION_ERROR * spread.max() and spread.min() > 0:
            what = f"one scaled by {spread.mean():.4g}" if determinant > 0 else "a mirror image, determinant -1"
        raise ValueError(f"{where} must be a rotation (R R^T = I within {ROTATION_ERROR}, determinant +1), got {what}")
    return matrix


def _axis(where: str, value: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis as it is, and offset in millimetres."""
    if not isinstance(value, dict):
        raise ValueError(f"{where} must be a JSON object with axis and offset, got {value!r:.60}")
    axis, offset = (_numbers(where, value, key, 3) for key in ("axis", "offset"))
    if not np.linalg.norm(axis) > 1e-6:
        raise ValueError(f"{where}: axis must have a direction, got {value['axis']}")
    return axis, offset


def _numbers(where: str, entry: Mapping[str, Any], key: str, count: int, wanted: str = "") -> NDArray[np.float64]:
    """``(count,)`` numbers, in lists of lists too."""
    if key not in entry:
        others = " ".join(", ".join(entry).split())[:60] or "nothing"
        raise ValueError(f"{where} must have {key}, got only {others}")
    values = [entry[key]]
    while count > 1 and any(isinstance(value, list) for value in values):
        values = [inner for value in values for inner in (value if isinstance(value, list) else [value])]
    are_numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    if len(values) != count or not are_numbers or not all(abs(value) <= MOST_NUMBER for value in values):
        wanted = wanted or ("a number" if count == 1 else f"{count} numbers")
        got = f"{len(values)} numbers" if are_numbers and len(values) != count else repr(entry[key])[:60]
        name = "" if key == "it" else f": {key}"
        raise ValueError(f"{where}{name} must be {wanted} within +-1e9, got {got}")
    return np.array(values, dtype=np.float64)
