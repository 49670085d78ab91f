"""Models of a BOP dataset: diameter and symmetry from ``models_info.json``, and the writer of both and of the meshes.

BOP's diameter is the largest vertex distance. Lengths are millimetres in the files and metres here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from attentionvote.datasets.text_files import number, read_json
from attentionvote.geometry.pose import quaternion_from_matrix, transform
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part

MODELS_INFO = "models_info.json"
FOLDERS = ("models", "models_eval", "models_cad", "models_reconst")
# A symmetry's axis may miss the model's origin by this share of the diameter.
OFFSET_SHARE = 0.01
MOST_ROTATIONS = 64


class BopModel(NamedTuple):
    """``diameter`` in metres and ``symmetry`` in the model's own frame."""

    diameter: float
    symmetry: Symmetry


def read_models_info(path: Path) -> dict[int, BopModel]:
    """Every model of a ``models_info.json`` by its object id.

    Raises:
        ValueError: with one sentence, when an entry is impossible, or has a symmetry that no ``Symmetry`` is.
    """
    models = {}
    for key, entry in read_json(path, dict).items():
        if not re.fullmatch(r"\d+", key) or not isinstance(entry, dict):
            raise ValueError(f"{path}: every key must be an object id with a mapping, got {key!r}")
        diameter = number(path, entry, "diameter")
        if not diameter > 0:
            raise ValueError(f"{path}: the diameter of object {key} must be positive millimetres, got {diameter}")
        models[int(key)] = BopModel(diameter / 1000, _symmetry(f"{path}: object {key}", entry, diameter))
    return models


def read_diameters(path: Path) -> dict[int, float]:
    """Diameters in metres by object id; the symmetries are not looked at.

    Raises:
        ValueError: with one sentence, when an entry has none.
    """
    content = read_json(path, dict)
    return {int(k): number(path, entry, "diameter") / 1000 for k, entry in content.items() if k.isdigit()}


def models_info_of(split: Path) -> Path | None:
    """The ``models_info.json`` beside a split's folder, or None."""
    for folder in FOLDERS:
        if (split.parent / folder / MODELS_INFO).is_file():
            return split.parent / folder / MODELS_INFO
    return None


def write_models(folder: Path, parts: Mapping[int, Part]) -> None:
    """Write ``models_info.json`` and a PLY in millimetres of every part, by object id."""
    folder.mkdir(parents=True, exist_ok=True)
    info = {}
    for object_id, part in parts.items():
        low, size = part.vertices.min(axis=0) * 1000, np.ptp(part.vertices, axis=0) * 1000
        entry: dict[str, Any] = {
            "diameter": float(pdist(part.vertices[ConvexHull(part.vertices).vertices]).max() * 1000)
        }
        entry |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        entry |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
        turns = part.symmetry.rotations()[1:]
        if len(turns):
            entry["symmetries_discrete"] = transform(turns, np.zeros(3)).reshape(-1, 16).tolist()
        if part.symmetry.is_revolution:
            entry["symmetries_continuous"] = [{"axis": list(part.symmetry.axis), "offset": [0, 0, 0]}]
        info[str(object_id)] = entry
        (folder / f"obj_{object_id:06d}.ply").write_text(_ply(part), encoding="ascii")
    (folder / MODELS_INFO).write_text(json.dumps(info, indent=2) + "\n", encoding="utf-8")


def _ply(part: Part) -> str:
    head = ["ply", "format ascii 1.0", f"element vertex {len(part.vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(part.faces)}", "property list uchar int vertex_indices", "end_header"]
    vertices = [" ".join(f"{value:.6g}" for value in vertex) for vertex in part.vertices * 1000]
    faces = [f"3 {a} {b} {c}" for a, b, c in part.faces]
    return "\n".join([*head, *vertices, *faces]) + "\n"


def _symmetry(where: str, entry: Mapping[str, Any], diameter_mm: float) -> Symmetry:
    try:
        discrete = np.asarray(entry.get("symmetries_discrete", []), dtype=np.float64).reshape(-1, 4, 4)
        continuous = [
            (np.asarray(e["axis"], dtype=np.float64).reshape(3), np.asarray(e["offset"], dtype=np.float64).reshape(3))
            for e in entry.get("symmetries_continuous", [])
        ]
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError(
            f"{where} must have symmetries_discrete of 16 numbers and symmetries_continuous of axis and offset"
        ) from error
    # The part of an offset along the axis is no offset.
    offsets = [np.linalg.norm(pose[:3, 3]) for pose in discrete]
    offsets += [np.linalg.norm(np.cross(axis, offset)) / np.linalg.norm(axis) for axis, offset in continuous]
    if max(offsets, default=0.0) > OFFSET_SHARE * diameter_mm:
        raise ValueError(
            f"{where} must have symmetry axes through its origin, within {OFFSET_SHARE:.0%} of the diameter, "
            f"got one {max(offsets):.3g} mm off: move the mesh's origin (`make part` does)"
        )
    turns = discrete[:, :3, :3]
    if not continuous:
        group = _closed(where, turns)
        return Symmetry("group", quaternions=quaternion_from_matrix(group).tolist()) if len(group) > 1 else Symmetry()
    axis = continuous[0][0] / np.linalg.norm(continuous[0][0])
    cosines = np.array([*(np.dot(a, axis) / np.linalg.norm(a) for a, _ in continuous), *(turns @ axis @ axis)])
    if (np.abs(cosines) < 0.999).any():
        raise ValueError(f"{where} must have one axis of revolution, got others beside {axis.round(3).tolist()}")
    return Symmetry("revolution", axis=tuple(axis.tolist()), flip=bool((turns @ axis @ axis < 0).any()))


def _closed(where: str, turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The group ``(G, 3, 3)`` that rotations ``(K, 3, 3)`` generate, identity first."""
    group = [np.eye(3)]
    pending = [_nearest_rotation(where, turn) for turn in turns]
    while pending:
        turn = pending.pop()
        if min(float(np.abs(turn - member).max()) for member in group) < 1e-3:
            continue
        group.append(turn)
        if len(group) > MOST_ROTATIONS:
            raise ValueError(f"{where} must have a symmetry group of at most {MOST_ROTATIONS} rotations, got more")
        pending += [product for member in group for product in (member @ turn, turn @ member)]
    return np.array(group)


def _nearest_rotation(where: str, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    u, spread, vt = np.linalg.svd(turn)
    if np.abs(spread - 1).max() > 0.01 or np.linalg.det(turn) < 0:
        raise ValueError(f"{where} must have rotations as symmetries_discrete, got {turn.round(3).tolist()}")
    return np.asarray(u @ vt)
