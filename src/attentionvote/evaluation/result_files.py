"""Ground-truth and result files in the Sileane layout (JSON, metres).

One file a scene, ``NAME.json``: ground truth is a list of ``{"R", "t", "occlusion_rate", ...}``, results
are a list of ``{"R", "t", "score"}``; ``R`` is 3x3 row-major and maps part to world or camera. A scene
without results is the empty list ``[]``: only scenes with a result file are counted.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from attentionvote.evaluation.scene_result import Array, SceneResult
from attentionvote.geometry.pose import rotation_problem, transform


def read_json(path: str | Path) -> Any:
    """The content of a JSON file.

    Raises:
        ValueError: with one sentence, when the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: the file cannot be read ({error.strerror})") from error
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError
        raise ValueError(f"{path}: the file must be JSON, got {error}") from error


def read_ground_truth(path: str | Path) -> tuple[Array, Array]:
    """Poses ``(I, 4, 4)`` in metres and occlusion rates ``(I,)`` of one scene.

    Raises:
        ValueError: with one sentence naming the file, the entry and the rule.
    """
    return _read(path, "occlusion_rate")


def read_results(path: str | Path) -> tuple[Array, Array]:
    """Poses ``(R, 4, 4)`` in metres and scores ``(R,)`` of one scene.

    Raises:
        ValueError: with one sentence naming the file, the entry and the rule.
    """
    return _read(path, "score")


def read_scene_results(gt_directory: str | Path, result_directory: str | Path) -> dict[str, SceneResult]:
    """Every scene that has a result file, by name (sorted).

    Raises:
        ValueError: with one sentence, when there is no result file, or one without ground truth, or the results are
            in another unit.
    """
    gt_directory, result_directory = Path(gt_directory), Path(result_directory)
    for directory in (gt_directory, result_directory):
        if not directory.is_dir():
            raise ValueError(f"{directory}: the folder of NAME.json files does not exist")
    results = sorted(result_directory.glob("*.json"))
    if not results:
        raise ValueError(f"{result_directory}: at least one NAME.json of results is needed, got none")
    truth_names = {path.stem for path in gt_directory.glob("*.json")}
    orphans = [path.name for path in results if path.stem not in truth_names]
    if orphans:
        raise ValueError(
            f"{result_directory}: every result file needs ground truth of the same name in {gt_directory}, "
            f"got {len(orphans)} without, the first is {orphans[0]}"
        )
    scenes = {}
    for path in results:
        poses, scores = read_results(path)
        gt_poses, occlusion = read_ground_truth(gt_directory / path.name)
        scenes[path.stem] = SceneResult(poses, scores, gt_poses, occlusion)
    estimated, true = (
        np.concatenate([getattr(s, name)[:, :3, 3] for s in scenes.values()]) for name in ("poses", "gt_poses")
    )
    if problem := unit_problem(estimated, true, "metres", "millimetres"):
        raise ValueError(f"{result_directory}: {problem}")
    return scenes


def unit_problem(translations: Array, gt_translations: Array, unit: str, other: str) -> str:
    """The end of a sentence when results ``(R, 3)`` and ground truth ``(I, 3)`` are surely in different units.

    Distances from the origin of the common frame are compared: medians that differ by more than a factor of 100 are
    a thousandfold one (m and mm), not poses. Empty when they agree or nothing can be said.

    Args:
        translations, gt_translations: in the unit that the files should have.
        unit, other: names of that unit and of the one that is taken for it.
    """
    if not len(translations) or not len(gt_translations):
        return ""
    median, true = (float(np.median(np.linalg.norm(t, axis=-1))) for t in (translations, gt_translations))
    if min(median, true) <= 0 or 0.01 <= median / true <= 100:
        return ""
    return (
        f"t must be in {unit}, as the ground truth is, got a median distance of {median:.4g} from the origin "
        f"where the ground truth has {true:.4g}; it looks like {other}"
    )


def _read(path: str | Path, value_key: str) -> tuple[Array, Array]:
    content = read_json(path)
    if not isinstance(content, list):
        raise ValueError(f"{path}: the file must hold a list of poses, got {type(content).__name__}")
    rotations, translations, values = (
        np.zeros((len(content), 3, 3)),
        np.zeros((len(content), 3)),
        np.zeros(len(content)),
    )
    for i, entry in enumerate(content):
        if not isinstance(entry, dict):
            raise ValueError(f"{path}: entry {i} must be an object with R, t and {value_key}, got {entry!r}")
        rotations[i] = _entry(path, i, entry, "R", (3, 3))
        translations[i] = _entry(path, i, entry, "t", (3,))
        values[i] = _entry(path, i, entry, value_key, ())
    if problem := rotation_problem(rotations):
        raise ValueError(f"{path}: R of entry {problem[0]} {problem[1]}")
    return transform(rotations, translations), values


def _entry(path: str | Path, index: int, entry: dict, key: str, shape: tuple[int, ...]) -> Array:
    if key not in entry:
        raise ValueError(f"{path}: entry {index} must have {key}, got only {', '.join(sorted(entry)) or 'nothing'}")
    try:
        value = np.asarray(entry[key], dtype=np.float64)
    except (TypeError, ValueError):
        value = np.asarray(np.nan)
    if key == "t" and value.shape == (3, 1):  # some writers keep the column
        value = value[:, 0]
    if value.shape != shape or not np.isfinite(value).all():
        wanted = {(): "a finite number", (3,): "three finite numbers", (3, 3): "3x3 finite numbers"}[shape]
        raise ValueError(f"{path}: {key} of entry {index} must be {wanted}, got {entry[key]!r}")
    return value
