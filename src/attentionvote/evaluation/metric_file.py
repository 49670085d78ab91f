"""Sileane's ``poseutils.json``: the pose distance of a part and the threshold at which a pose counts as right."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from attentionvote.evaluation.pose_distance import PoseMetric
from attentionvote.evaluation.result_files import read_json
from attentionvote.evaluation.scene_result import Array
from attentionvote.geometry.pose import inverse, quaternion_from_matrix, rotation_problem, transform
from attentionvote.geometry.symmetry import Symmetry

Frame = Literal["toolbox", "object"]
KINDS = ("AffinePoseUtils", "RevolutionPoseUtils")


def read_metric(path: str | Path, frame: Frame = "toolbox") -> tuple[PoseMetric, float]:
    """The metric and the distance threshold (metres) in a Sileane ``poseutils.json`` (shared/reference, 1b and 2).

    ``AffinePoseUtils`` holds ``Lambda`` and the proper group ``G``, ``RevolutionPoseUtils`` holds ``lambda`` and
    ``rotoreflection_symmetry`` (may the body be turned over; the axis is z).

    Args:
        path: the file.
        frame: ``toolbox``: the published program multiplies ``Rref2i``, ``tref2i`` from the left, a motion of the
            whole scene that cancels in every distance, so they are left out. ``object``: they are applied to the
            part, as Bregier et al. mean it; other figures below 2 % of the diameter.

    Raises:
        ValueError: with one sentence, when the file does not describe a metric.
    """
    if frame not in get_args(Frame):
        raise ValueError(f"frame must be one of {', '.join(get_args(Frame))}, got {frame!r}")
    content = read_json(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: the file must hold an object with type, got {type(content).__name__}")
    kind = content.get("type")
    if kind not in KINDS:
        raise ValueError(f"{path}: type must be {' or '.join(KINDS)}, got {kind!r}{_nearest(kind, KINDS, 0.3)}")
    if kind == "AffinePoseUtils":
        root, symmetry = _matrix(path, content, "Lambda", (3, 3)), _group(path, content)
    else:
        # The file gives lambda alone; any root with lambda_r^2 + lambda_z^2 = lambda^2 is the same metric.
        root = np.eye(3) * float(_matrix(path, content, "lambda", ())) / np.sqrt(2.0)
        flip = content.get("rotoreflection_symmetry", False)
        if flip not in (True, False):
            raise ValueError(f"{path}: rotoreflection_symmetry must be true or false, got {flip!r}")
        symmetry = Symmetry("revolution", flip=bool(flip))
    threshold = float(_matrix(path, content, "distance_threshold", ()))
    if threshold < 0:
        raise ValueError(f"{path}: distance_threshold must be at least 0 metres, got {threshold}")
    if frame == "toolbox":
        return PoseMetric(symmetry, root), threshold
    rotation, translation = (_matrix(path, content, k, s) for k, s in (("Rref2i", (3, 3)), ("tref2i", (3, 1))))
    _check_rotations(path, "Rref2i", rotation[None])
    return PoseMetric(symmetry, root, inverse(transform(rotation, translation[:, 0]))), threshold


def _group(path: str | Path, content: dict[str, Any]) -> Symmetry:
    rotations = _matrix(path, content, "G", (-1, 3, 3))
    _check_rotations(path, "G", rotations)
    if len(rotations) == 1 and np.allclose(rotations[0], np.eye(3), atol=1e-9):
        return Symmetry()
    try:
        return Symmetry("group", quaternions=quaternion_from_matrix(rotations).tolist())
    except ValueError as error:
        raise ValueError(f"{path}: G must be a group: {error}") from error


def _check_rotations(path: str | Path, key: str, rotations: Array) -> None:
    if problem := rotation_problem(rotations):
        raise ValueError(f"{path}: {key}[{problem[0]}] {problem[1]}")


def _matrix(path: str | Path, content: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    if key not in content:
        present = [name for name in content if name != "type"]
        raise ValueError(
            f"{path}: {key} must be given, got only {', '.join(present) or 'type'}{_nearest(key, present, 0.6)}"
        )
    try:
        value = np.asarray(content[key], dtype=np.float64)
    except (TypeError, ValueError):
        value = np.full(1, np.nan)
    fits = value.ndim == len(shape) and all(n in (-1, m) and m > 0 for n, m in zip(shape, value.shape, strict=True))
    if not fits or not np.isfinite(value).all():
        wanted = "one number" if not shape else " x ".join("n" if n < 0 else str(n) for n in shape) + " finite numbers"
        raise ValueError(f"{path}: {key} must be {wanted}, got {content[key]!r}")
    return value


def _nearest(name: object, valid: list[str] | tuple[str, ...], cutoff: float) -> str:
    lower = {v.lower(): v for v in valid}
    close = get_close_matches(str(name).lower(), lower, n=1, cutoff=cutoff)
    return f", did you mean {lower[close[0]]!r}?" if close else ""
