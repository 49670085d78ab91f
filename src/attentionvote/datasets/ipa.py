"""Reader of the Fraunhofer IPA bin-picking dataset: synthetic and real splits, perspective pictures.

Layout: ``<split>/<Object>[_part_N]/`` with ``parameter.json`` and, per drop cycle, ``gt/cycle_0250/007.csv``,
``p_depth/cycle_0250/007_depth_uint16.png`` and ``p_segmentation/cycle_0250/007_segmentation.png``; 007 is the number
of parts dropped, 000 the empty bin. Real pictures are in ``p_depth_real_world/``.

The dataset's camera frame has x and y negated against the image's axes and its pixel centres at halves:
x = -(u + offset + 0.5 - res_big / 2) z / f. Half a turn about z makes it OpenCV's; points and poses both take it, so
the principal point is at res_big / 2 - 0.5 - offset and every pose is multiplied by diag(-1, -1, 1) from the left.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.benchmark_objects import benchmark_object
from attentionvote.datasets.dataset import Frame, GroundTruth
from attentionvote.datasets.depth_image import DepthCoding, PinholeCamera
from attentionvote.datasets.pose_rules import check_depth_range, poses_in_metres
from attentionvote.datasets.scene_files import SceneFiles
from attentionvote.datasets.text_files import number, read_json, read_text

OPENCV_FROM_IPA = np.diag([-1.0, -1.0, 1.0, 1.0])
ROTATION_COLUMNS = tuple(f"rot_{axis}_axis_{i}" for axis in "xyz" for i in (1, 2, 3))
COLUMNS = ("id", "class", "x", "y", "z", *ROTATION_COLUMNS, "visibility_score_o", "visibility_score_p")
DEPTH_SUFFIX, LABEL_SUFFIX = "_depth_uint16.png", "_segmentation.png"
MISSING = (0, 65535)
LABEL_OF_BIN, LABEL_OF_NOTHING = 0, 255
# What differs from the empty bin by no more is the bin, in real pictures; synthetic ones are equal to the count.
REAL_TOLERANCE = 0.005


class IpaParameters(NamedTuple):
    """What ``parameter.json`` says: the camera in the OpenCV convention and the coding of depth."""

    camera: PinholeCamera
    coding: DepthCoding


def read_parameters(path: Path) -> IpaParameters:
    """Camera and depth coding of a ``parameter.json``.

    Raises:
        ValueError: with one sentence, when a key is missing or impossible.
    """
    content = read_json(path, dict)
    get = {
        key: number(path, content, key)
        for key in ("resolutionX", "resolutionY", "resolution_big", "perspectiveAngle", "clip_start", "clip_end")
    }
    offset_x, offset_y = (number(path, content, f"pixelOffset_{axis}_KoSyTopLeft") for axis in "XY")
    check_depth_range(path, get["clip_start"], get["clip_end"])
    angle = get["perspectiveAngle"]
    if not 1 < angle < 179:
        raise ValueError(f"{path}: perspectiveAngle must be degrees between 1 and 179, got {angle}: is it in radians?")
    big = get["resolution_big"]
    focal = big / (2 * np.tan(np.radians(angle) / 2))
    try:
        camera = PinholeCamera(
            int(get["resolutionX"]),
            int(get["resolutionY"]),
            focal,
            focal,
            big / 2 - 0.5 - offset_x,
            big / 2 - 0.5 - offset_y,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return IpaParameters(camera, DepthCoding.between(get["clip_start"], get["clip_end"], MISSING))


def read_ground_truth(path: Path) -> GroundTruth:
    """Ground truth of one CSV file; its first row is the bin (id 0) and no part.

    Visibility may exceed 1 in the file and is cut there (occlusion rate = 1 - min(v, 1)).

    Raises:
        ValueError: with one sentence, when the file is missing or breaks a rule of the format.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if not lines:  # written for an empty bin
        return GroundTruth.none()
    header = [word.strip() for word in lines[0].split(",")]
    lacking = [name for name in COLUMNS if name not in header and name not in ("class", "visibility_score_o")]
    if lacking:
        raise ValueError(f"{path}: the first line must name the column {lacking[0]}, got {', '.join(header[:5])}, ...")
    wanted = ("id", "x", "y", "z", *ROTATION_COLUMNS, "visibility_score_p")
    places = [header.index(name) for name in wanted]
    try:
        rows = list(csv.reader(lines[1:]))
        table = np.array([[float(row[column]) for column in places] for row in rows]).reshape(-1, len(places))
    except (ValueError, IndexError, csv.Error) as error:
        raise ValueError(f"{path}: every row must have {len(header)} values, numbers in the named columns") from error
    ids = table[:, 0]
    if len(ids) == 0 or ids[0] != 0:
        raise ValueError(f"{path}: the first row must be the bin, id 0, got id {ids[0] if len(ids) else 'none'}")
    table, ids = table[1:], ids[1:].astype(np.int64)
    if len(set(ids)) != len(ids) or (len(ids) and not (ids.min() > 0 and ids.max() < 10**6)):
        raise ValueError(f"{path}: ids of parts must be different whole numbers above 0, got {ids.tolist()}")
    visible = table[:, -1]
    if not (visible >= 0).all():
        raise ValueError(f"{path}: visibility_score_p must be at least 0, got {np.min(visible)}")
    # rot_x_axis_* is the first column of R: the nine numbers are column by column.
    rotations = np.swapaxes(table[:, 4:13].reshape(-1, 3, 3), -1, -2)
    poses = poses_in_metres(path, rotations, table[:, 1:4])
    return GroundTruth(OPENCV_FROM_IPA @ poses, np.minimum(visible, 1.0), np.zeros(len(ids), np.int32), ids)


class IpaDataset(SceneFiles):
    """All parts (``_part_1``, ``_part_2``, ...) of one object in one split.

    Args:
        folders: of the parts, each with a ``parameter.json``.
        real: read the real pictures instead of the synthetic ones. Their labels come from ``gt_real_world`` and
            ``p_segmentation_real_world``, or from ``gt`` and ``p_segmentation`` of a folder without ``p_depth``.
        split: see ``Dataset``.

    A scene's name is ``cycle_0250/007``.

    Raises:
        ValueError: with one sentence, when there is no folder, or one cycle is in two of them.
    """

    format = "ipa"

    def __init__(self, folders: Sequence[Path], real: bool = False, split: str = "") -> None:
        if not folders:
            raise ValueError("an IPA dataset must have at least one folder, got none")
        self._folders = tuple(sorted(folders))
        self.directory = self._folders[0]
        self.real = real
        self.title = re.sub(r"_part_\d+$", "", self.directory.resolve().name)
        benchmark = benchmark_object(self.title)
        self.parts = (benchmark.name if benchmark else self.title,)
        self.split = "real" if real else split
        self._files: dict[str, dict[str, Path]] = {"depth": {}, "gt": {}, "labels": {}}
        self._part_of_cycle: dict[str, Path] = {}
        self._by_folder: dict[Path, IpaParameters] = {}
        for folder in self._folders:
            self._collect(folder)
        self.names = tuple(sorted(set().union(*self._files.values())))
        self.has_labels = bool(self._files["labels"])

    def drop_count(self, name: str) -> int:
        """The number in the file's name."""
        return int(self._checked(name).partition("/")[2])

    def camera(self, name: str) -> PinholeCamera:
        """Intrinsics, from the ``parameter.json`` of the scene's part."""
        return self._parameters(name).camera

    def ground_truth(self, name: str) -> GroundTruth:
        """Poses in the OpenCV frame; see ``read_ground_truth``."""
        path = self._file(name, "gt")
        truth = read_ground_truth(path)
        if len(truth.camera_from_part) != self.drop_count(name):
            raise ValueError(
                f"{path}: the file must have a row for the bin and {self.drop_count(name)} for the parts, "
                f"got {len(truth.camera_from_part)} parts"
            )
        return truth

    def picture_rule(self, name: str) -> str:
        """What ``parameter.json`` of the scene's part says."""
        return repr(self._parameters(name))

    def frame(self, name: str, labels: bool = True) -> Frame:
        """The picture of a scene; the background is the picture of the same cycle's empty bin."""
        depth, truth, instance, unknown = self._seen(name, labels, (LABEL_OF_BIN, LABEL_OF_NOTHING))
        empty = f"{name.partition('/')[0]}/000"
        return Frame(
            depth=depth,
            instance=instance,
            unknown_pixels=unknown,
            camera=self.camera(name),
            ground_truth=truth,
            background=self._depth(empty) if empty in self._files["depth"] else None,
            background_tolerance=REAL_TOLERANCE if self.real else 0.0,
            nearest=self.benchmark.nearest if self.real and self.benchmark else None,
        )

    @property
    def camera_from_file(self) -> NDArray[np.float64]:
        """Half a turn about z."""
        return OPENCV_FROM_IPA

    def _collect(self, folder: Path) -> None:
        depth, gt, labels = "p_depth", "gt", "p_segmentation"
        if self.real:
            depth = "p_depth_real_world"
            only_real = not (folder / "p_depth").is_dir()
            gt = "gt" if only_real and not (folder / "gt_real_world").is_dir() else "gt_real_world"
            real_labels = f"{labels}_real_world"
            labels = labels if only_real and not (folder / real_labels).is_dir() else real_labels
        for kind, subfolder, suffix in (
            ("depth", depth, DEPTH_SUFFIX),
            ("gt", gt, ".csv"),
            ("labels", labels, LABEL_SUFFIX),
        ):
            for path in (folder / subfolder).glob(f"cycle_*/*{suffix}"):
                count = path.name.removesuffix(suffix)
                if not count.isdigit():
                    continue
                cycle = path.parent.name
                if self._part_of_cycle.setdefault(cycle, folder) != folder:
                    raise ValueError(
                        f"{cycle} must be in one part of the object, got it in "
                        f"{self._part_of_cycle[cycle]} and {folder}"
                    )
                self._files[kind][f"{cycle}/{int(count):03d}"] = path

    def _parameters(self, name: str) -> IpaParameters:
        folder = self._part_of_cycle[self._checked(name).partition("/")[0]]
        if folder not in self._by_folder:
            self._by_folder[folder] = read_parameters(folder / "parameter.json")
        return self._by_folder[folder]

    def _coding(self, name: str) -> DepthCoding:
        return self._parameters(name).coding
