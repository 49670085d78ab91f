"""BOP's files (docs/bop_datasets_format.md of the BOP toolkit): result CSVs, ground truth of a split, targets.

On disk lengths are millimetres; everything here is in metres.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.evaluation.result_files import read_json
from attentionvote.evaluation.scene_result import Array
from attentionvote.geometry.pose import rotation_problem, transform

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
NAME_RULE = "METHOD_DATASET-SPLIT[-TYPE][_ID].csv"
Ids = NDArray[np.int64]
Image = tuple[int, int]  # scene and image number


class BopName(NamedTuple):
    """What a result file's name says."""

    method: str
    dataset: str
    split: str


class BopPoses(NamedTuple):
    """Poses of a whole split, in no particular order.

    ``images`` ``(N, 2)``: scene and image number; ``objects`` ``(N,)``; ``poses`` ``(N, 4, 4)``
    ``camera_from_part`` in metres; ``values`` ``(N,)``: score of a result, visible fraction of a true pose.
    """

    images: Ids
    objects: Ids
    poses: Array
    values: Array


def parse_name(path: str | Path) -> BopName:
    """Method, data set and split of a result file by its name.

    Raises:
        ValueError: with one sentence, when the name does not follow ``NAME_RULE``.
    """
    path = Path(path)
    parts = path.stem.split("_")
    if path.suffix == ".csv" and len(parts) in (2, 3) and parts[0] and re.fullmatch(r"[^-]+(-[^-]+)+", parts[1]):
        dataset, split = parts[1].split("-", 1)
        return BopName(parts[0], dataset, split)
    hint = ""
    index = next((i for i, part in enumerate(parts[1:], 1) if re.fullmatch(r"[^-]+(-[^-]+)+", part)), None)
    if path.suffix == ".csv" and index is not None and index > 1:  # an underscore in the method
        hint = f", did you mean '{'_'.join(['-'.join(parts[:index]), *parts[index:]])}.csv'?"
    raise ValueError(
        f"{path}: the file must be named {NAME_RULE} without an underscore in METHOD, got {path.name!r}{hint}"
    )


def read_estimates(path: str | Path) -> tuple[BopPoses, float | None]:
    """The results of a CSV file, in its order, and the mean seconds an image, None where a time is -1 (unknown).

    Raises:
        ValueError: with one sentence naming the line and the rule.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ValueError(f"{path}: the file cannot be read ({error.strerror})") from error
    if not lines or lines[0].strip() != HEADER:
        raise ValueError(f"{path}: the first line must be {HEADER}, got {lines[0][:80] if lines else 'an empty file'}")
    rows = [(number, line.split(",")) for number, line in enumerate(lines[1:], 2) if line.strip()]
    count = len(rows)
    ids, scores, times = np.zeros((count, 3), dtype=np.int64), np.zeros(count), np.zeros(count)
    rotations, translations = np.zeros((count, 9)), np.zeros((count, 3))
    for i, (number, values) in enumerate(rows):
        where = f"{path}: line {number}"
        if len(values) != 7:
            raise ValueError(f"{where} must have 7 values between commas, {HEADER}, got {len(values)}")
        try:
            ids[i] = [int(v) for v in values[:3]]
        except ValueError:
            raise ValueError(f"{where} must begin with three whole numbers, got {','.join(values[:3])}") from None
        scores[i] = _numbers(where, "score", values[3], 1)[0]
        rotations[i], translations[i] = _numbers(where, "R", values[4], 9), _numbers(where, "t", values[5], 3)
        times[i] = _numbers(where, "time", values[6], 1)[0]
    matrices = rotations.reshape(-1, 3, 3)
    if problem := rotation_problem(matrices):
        raise ValueError(f"{path}: R of line {rows[problem[0]][0]} {problem[1]}")
    poses = BopPoses(ids[:, :2], ids[:, 2], transform(matrices, translations / 1000), scores)
    return poses, _seconds_an_image(path, [number for number, _ in rows], poses.images, times)


def read_truth(split: str | Path, suffix: str | None = None) -> tuple[BopPoses, list[Image]]:
    """True poses with their visible fractions of every scene folder of a split, and all its images, sorted.

    Args:
        split: folder with ``000001/scene_gt.json`` and ``000001/scene_gt_info.json``, and so on.
        suffix: of ``scene_gt_SUFFIX.json`` in data of several sensors.

    Raises:
        ValueError: with one sentence naming the file and the rule.
    """
    split = Path(split)
    ending = f"_{suffix}.json" if suffix else ".json"
    folders = sorted(p for p in split.iterdir() if p.name.isdecimal()) if split.is_dir() else []
    folders = [folder for folder in folders if (folder / f"scene_gt{ending}").is_file()]
    if not folders:
        others = sorted({p.name for p in split.glob("[0-9]*/scene_gt*.json") if "info" not in p.name})
        hint = f", but there is {others[0]}" if others else ""
        raise ValueError(f"{split}: at least one folder NNNNNN with scene_gt{ending} is needed, got none{hint}")
    images: list[Image] = []
    entries: list[tuple[Image, int, Array, Array, float]] = []
    for folder in folders:
        truth, facts = (_object(folder / f"{name}{ending}") for name in ("scene_gt", "scene_gt_info"))
        for key, listed in truth.items():
            image = (int(folder.name), int(key))
            images.append(image)
            seen = facts.get(key, [])
            if len(seen) != len(listed):
                raise ValueError(
                    f"{folder / f'scene_gt_info{ending}'}: image {key} must have {len(listed)} entries, as in "
                    f"scene_gt{ending}, got {len(seen)}"
                )
            for index, (entry, fact) in enumerate(zip(listed, seen, strict=True)):
                where = f"{folder / f'scene_gt{ending}'}: entry {index} of image {key}"
                rotation = _array(where, entry, "cam_R_m2c", 9).reshape(3, 3)
                if problem := rotation_problem(rotation[None]):
                    raise ValueError(f"{where}: cam_R_m2c {problem[1]}")
                translation = _array(where, entry, "cam_t_m2c", 3) / 1000
                visible = _array(where.replace("scene_gt", "scene_gt_info"), fact, "visib_fract", 1)
                number = int(_array(where, entry, "obj_id", 1)[0])
                entries.append((image, number, rotation, translation, float(visible[0])))
    return BopPoses(
        np.array([e[0] for e in entries], dtype=np.int64).reshape(-1, 2),
        np.array([e[1] for e in entries], dtype=np.int64),
        transform(*(np.array([e[i] for e in entries]).reshape(-1, *s) for i, s in ((2, (3, 3)), (3, (3,))))),
        np.array([e[4] for e in entries]),
    ), sorted(images)


def read_targets(path: str | Path) -> set[Image]:
    """The images of a file of targets, e.g. ``test_targets_bop24.json``: only they are evaluated.

    Raises:
        ValueError: with one sentence, when the file is no list of targets.
    """
    content = read_json(path)
    if not isinstance(content, list) or not all(
        isinstance(e, dict) and {"scene_id", "im_id"} <= set(e) for e in content
    ):
        raise ValueError(f"{path}: the file must hold a list of objects with scene_id and im_id")
    return {(int(entry["scene_id"]), int(entry["im_id"])) for entry in content}


def _seconds_an_image(path: str | Path, lines: list[int], images: Ids, times: Array) -> float | None:
    first: dict[Image, float] = {}
    for line, (scene, image), seconds in zip(lines, images.tolist(), times.tolist(), strict=True):
        if abs(first.setdefault((scene, image), seconds) - seconds) > 0.001:
            raise ValueError(
                f"{path}: time of line {line} must be that of the other rows of scene {scene}, image {image}, "
                f"{first[scene, image]:g}, got {seconds:g}"
            )
    return float(np.mean(list(first.values()))) if first and min(first.values()) >= 0 else None


def _numbers(where: str, name: str, text: str, count: int) -> Array:
    try:
        values = np.array([float(v) for v in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        wanted = "one finite number" if count == 1 else f"{count} finite numbers between spaces"
        raise ValueError(f"{where}: {name} must be {wanted}, got {text.strip()[:80]!r}")
    return values


def _object(path: str | Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict) or not all(key.isdecimal() for key in content):
        raise ValueError(f"{path}: the file must hold an object whose keys are numbers")
    return content


def _array(where: str, entry: Any, key: str, count: int) -> Array:
    if not isinstance(entry, dict) or key not in entry:
        present = ", ".join(entry) if isinstance(entry, dict) and entry else "nothing"
        raise ValueError(f"{where} must have {key}, got only {present}")
    try:
        values = np.asarray(entry[key], dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{where}: {key} must be {count} finite numbers, got {entry[key]!r}")
    return values
