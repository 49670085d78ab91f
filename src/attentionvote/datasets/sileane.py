"""Reader of the Sileane dataset.

Layout of an object's folder: ``camera_params.txt``, ``depth/NAME.PNG`` (or ``depth_gt``, rendered),
``segmentation/NAME.PNG``, ``gt/NAME.json``, ``poseutils.json``; NAME is ``bunny_3_070``: object, cycle, drops.

Poses are in a world frame, X_world = R_camera X_camera + location; here they are moved into the camera's, which is
OpenCV's already: x = (u - cu) z / fu, no half pixel. Label of the k-th of n parts: round(65535 (n - k) / n),
halves upwards.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.benchmark_objects import benchmark_object
from attentionvote.datasets.dataset import Frame, GroundTruth
from attentionvote.datasets.depth_image import TOP, DepthCoding, PinholeCamera
from attentionvote.datasets.pose_rules import check_depth_range, poses_in_metres
from attentionvote.datasets.scene_files import SceneFiles
from attentionvote.datasets.text_files import number, read_json, read_text
from attentionvote.geometry.pose import inverse, matrix_from_quaternion

MISSING = (65535,)
LABEL_OF_BACKGROUND = 0
CAMERA_FILE = "camera_params.txt"
DEPTH_FOLDERS = ("depth", "depth_gt")
# distance_threshold of poseutils.json is a tenth of D.
THRESHOLD_SHARE = 0.1
# Noise of a real scanner: what differs from the empty bin by no more is the bin.
BACKGROUND_TOLERANCE = 0.005


class SileaneCamera(NamedTuple):
    """What ``camera_params.txt`` says: intrinsics, coding of depth, ``world_from_camera`` ``(4, 4)``."""

    camera: PinholeCamera
    coding: DepthCoding
    world_from_camera: NDArray[np.float64]


def label_of(index: int, count: int) -> int:
    """Label of part ``index`` of ``count``; halves go up, as in the dataset's own files (``round`` does not)."""
    return (2 * TOP * (count - index) + count) // (2 * count)


def read_camera(path: Path) -> SileaneCamera:
    """The camera of a ``camera_params.txt``: a key and its values a line, ``#`` begins a comment.

    Raises:
        ValueError: with one sentence, when a key is missing or impossible.
    """
    lines = [line.partition("#")[0].split() for line in read_text(path).splitlines()]
    values_by_key = {words[0]: words[1:] for words in lines if words}
    singles = {key: values[0] for key, values in values_by_key.items() if len(values) == 1}
    keys = ("width", "height", "fu", "fv", "cu", "cv", "clip_start", "clip_end")
    width, height, fu, fv, cu, cv, clip_start, clip_end = (number(path, singles, key) for key in keys)
    check_depth_range(path, clip_start, clip_end)
    location, rotation = (
        _numbers(path, values_by_key, key, count) for key, count in (("location", 3), ("rotation", 4))
    )
    if not 0.99 < np.linalg.norm(rotation) < 1.01:
        raise ValueError(f"{path}: rotation must be a unit quaternion w x y z, got {rotation.tolist()}")
    try:
        camera = PinholeCamera(int(width), int(height), fu, fv, cu, cv)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    pose = poses_in_metres(path, matrix_from_quaternion(rotation)[None], location[None])[0]
    return SileaneCamera(camera, DepthCoding.between(clip_start, clip_end, MISSING), pose)


def read_world_poses(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """``world_from_part`` ``(I, 4, 4)``, occlusion rates ``(I,)`` and labels ``(I,)`` of a ground-truth file.

    Raises:
        ValueError: with one sentence, when the file is missing or breaks a rule of the format.
    """
    entries = read_json(path, list)
    for index, entry in enumerate(entries):
        lacking = [key for key in ("R", "t", "occlusion_rate") if not isinstance(entry, dict) or key not in entry]
        if lacking:
            raise ValueError(f"{path}: entry {index} must be an object with {lacking[0]}, got {entry!r:.60}")
    poses = poses_in_metres(path, [e["R"] for e in entries], [e["t"] for e in entries])
    occlusion = np.array([number(path, e, "occlusion_rate") for e in entries])
    if len(occlusion) and not (occlusion.min() >= -0.01 and occlusion.max() <= 1.01):
        raise ValueError(f"{path}: occlusion_rate must lie in 0..1, got {occlusion.min():.3g}..{occlusion.max():.3g}")
    count = len(entries)
    labels = np.array(
        [
            number(path, e, "segmentation_id") if "segmentation_id" in e else label_of(k, count)
            for k, e in enumerate(entries)
        ]
    ).astype(np.int64)
    if len(set(labels)) != count or (count and not (labels.min() > LABEL_OF_BACKGROUND and labels.max() <= TOP)):
        raise ValueError(f"{path}: segmentation_id must be different whole numbers in 1..{TOP}, got {labels.tolist()}")
    return poses, occlusion, labels


class SileaneDataset(SceneFiles):
    """One object of the Sileane dataset.

    Args:
        directory: the object's folder, with a ``camera_params.txt``.
        depth_folder: ``depth`` as measured, or ``depth_gt`` as rendered.

    Names are ordered by cycle, then by number of parts.
    """

    format = "sileane"
    split = "test"

    def __init__(self, directory: Path, depth_folder: str = "depth") -> None:
        self.directory = directory
        self._files = {
            kind: {
                path.stem: path
                for path in (directory / folder).glob("*")
                if path.suffix.lower() == suffix and not path.name.startswith(".")
            }
            for kind, folder, suffix in (
                ("depth", depth_folder, ".png"),
                ("gt", "gt", ".json"),
                ("labels", "segmentation", ".png"),
            )
        }
        self.names = tuple(sorted(set().union(*self._files.values()), key=_order))
        objects = sorted({_order(name)[0] for name in self.names if _order(name)[1] >= 0})
        self.title = objects[0] if objects else directory.resolve().name
        benchmark = benchmark_object(self.title) or benchmark_object(directory.resolve().name)
        self.parts = (benchmark.name if benchmark else self.title,)
        self.has_labels = bool(self._files["labels"])

    @property
    def diameters(self) -> tuple[float | None, ...]:
        """D from ``poseutils.json`` where it is there, else of Table 1."""
        path = self.directory / "poseutils.json"
        if path.is_file():
            return (number(path, read_json(path, dict), "distance_threshold") / THRESHOLD_SHARE,)
        return super().diameters

    @property
    def camera_from_file(self) -> NDArray[np.float64]:
        """From the world's frame into the camera's."""
        return inverse(self._camera.world_from_camera)

    def drop_count(self, name: str) -> int:
        """The last number of the name; of another name the entries of its ground truth."""
        count = _order(self._checked(name))[2]
        return count if count >= 0 else len(self.ground_truth(name).camera_from_part)

    def camera(self, name: str) -> PinholeCamera:
        """Intrinsics; the same for every scene."""
        self._checked(name)
        return self._camera.camera

    def ground_truth(self, name: str) -> GroundTruth:
        """Poses in the camera frame."""
        poses, occlusion, labels = read_world_poses(self._file(name, "gt"))
        return GroundTruth(
            self.camera_from_file @ poses,
            np.clip(1.0 - occlusion, 0.0, 1.0),
            np.zeros(len(poses), np.int32),
            labels,
        )

    def picture_rule(self, name: str) -> str:
        """What ``camera_params.txt`` says."""
        self._checked(name)
        return f"{self._camera.camera} {self._camera.coding} {self._camera.world_from_camera.tolist()}"

    def cycle_of(self, name: str) -> str:
        """Object and cycle, ``bunny_3``; of another name the whole."""
        part, cycle, _ = _order(self._checked(name))
        return f"{part}_{cycle}" if cycle >= 0 else name

    def frame(self, name: str, labels: bool = True) -> Frame:
        """The picture of a scene. The bin's floor is beyond a depth that is known for the paper's objects; for others
        the same cycle's scene without parts shows it.
        """
        depth, truth, instance, unknown = self._seen(name, labels, (LABEL_OF_BACKGROUND,))
        farthest = self.benchmark.farthest if self.benchmark else None
        empty = f"{name.rpartition('_')[0]}_000"
        by_picture = farthest is None and empty in self._files["depth"]
        return Frame(
            depth=depth,
            instance=instance,
            unknown_pixels=unknown,
            camera=self._camera.camera,
            ground_truth=truth,
            background=self._depth(empty) if by_picture else None,
            background_tolerance=BACKGROUND_TOLERANCE,
            farthest=farthest,
        )

    @cached_property
    def _camera(self) -> SileaneCamera:
        return read_camera(self.directory / CAMERA_FILE)

    def _coding(self, name: str) -> DepthCoding:
        del name
        return self._camera.coding


def _order(name: str) -> tuple[str, int, int]:
    """Object, cycle and count of a name; -1 where it has none."""
    words = name.rsplit("_", 2)
    if len(words) == 3 and words[1].isdigit() and words[2].isdigit():
        return words[0], int(words[1]), int(words[2])
    return name, -1, -1


def _numbers(path: Path, values_by_key: dict[str, list[str]], key: str, count: int) -> NDArray[np.float64]:
    values = values_by_key.get(key, [])
    if len(values) != count:
        raise ValueError(f"{path}: {key} must have {count} numbers, got {len(values)}")
    return np.array([number(path, {key: value}, key) for value in values])
