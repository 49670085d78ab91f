"""Reader of the BOP format (docs/bop_datasets_format.md of the BOP toolkit), BOP-Industrial's several sensors included.

Layout: ``<dataset>/<split>/000000/`` with ``scene_camera.json``, ``scene_gt.json``, ``scene_gt_info.json``,
``depth/000003.png`` and ``mask_visib/000003_000012.png``, and ``<dataset>/models/models_info.json``. A sensor of a
multi-sensor set is a suffix of all of these: ``scene_gt_photoneo.json``, ``depth_photoneo/``. Files are in millimetres,
OpenCV camera frame, pixel centres at whole numbers; a depth of 0 is missing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.bop_models import models_info_of, read_diameters
from attentionvote.datasets.dataset import Dataset, Frame, GroundTruth
from attentionvote.datasets.depth_image import DepthCoding, PinholeCamera, image_size, read_depth_counts, read_labels
from attentionvote.datasets.pose_rules import FARTHEST, poses_in_millimetres
from attentionvote.datasets.text_files import number, read_json
from attentionvote.scene import BACKGROUND

MISSING = (0,)
NEAREST = 0.02  # metres; no depth sensor measures this near


class _SceneFiles(NamedTuple):
    camera: dict[str, Any]
    gt: dict[str, Any] | None
    info: dict[str, Any] | None


class BopDataset(Dataset):
    """All scenes of one split and sensor.

    Args:
        folders: of the scenes, ``<split>/000000``.
        sensor: the suffix without its underscore; empty: the only sensor.

    A picture's name is ``000000/000003``, scene and image. ``part_ids`` index ``object_ids``.
    """

    format = "bop"

    def __init__(self, folders: Sequence[Path], sensor: str = "") -> None:
        if not folders:
            raise ValueError("a BOP dataset must have at least one scene's folder, got none")
        self.sensor, self._suffix = sensor, f"_{sensor}" if sensor else ""
        self._folders = {folder.name: folder for folder in sorted(folders)}
        self.directory = sorted(folders)[0].resolve().parent
        self.split = self.directory.name
        self.title = self.directory.parent.name + (f" ({sensor})" if sensor else "")
        self._loaded: tuple[str, _SceneFiles] | None = None
        self.names = tuple(
            f"{scene}/{int(image):06d}"
            for scene, folder in self._folders.items()
            for image in sorted(read_json(folder / f"scene_camera{self._suffix}.json", dict), key=_image_id)
        )
        info = models_info_of(self.directory)
        self._diameters = read_diameters(info) if info is not None else {}
        self.object_ids = tuple(sorted(self._diameters)) or self._object_ids_in_use()
        self.parts = tuple(f"obj_{object_id:06d}" for object_id in self.object_ids)
        self.has_labels = any((folder / f"mask_visib{self._suffix}").is_dir() for folder in self._folders.values())

    @property
    def diameters(self) -> tuple[float | None, ...]:
        """D of every object from ``models_info.json``: the largest vertex distance."""
        return tuple(self._diameters.get(object_id) for object_id in self.object_ids)

    def drop_count(self, name: str) -> int:
        """Number of entries in the ground truth."""
        return len(self._entries(name)[0])

    def camera(self, name: str) -> PinholeCamera:
        """Intrinsics; the size is the picture's own."""
        path, entry = self._camera_entry(name)
        matrix = entry.get("cam_K")
        try:
            k = np.asarray(matrix, dtype=np.float64).reshape(3, 3)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: cam_K of image {name} must be nine numbers, got {matrix!r:.60}") from error
        if not np.isfinite(k).all() or np.abs([k[0, 1], k[1, 0]]).max() > 1e-6 or np.abs(k[2] - (0, 0, 1)).max() > 1e-6:
            raise ValueError(
                f"{path}: cam_K of image {name} must be row by row fx 0 cx 0 fy cy 0 0 1, got {k.ravel().tolist()}"
            )
        width, height = image_size(self._depth_file(name))
        return PinholeCamera(width, height, *(float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])))

    def ground_truth(self, name: str) -> GroundTruth:
        """Poses and visible fractions; without ``scene_gt_info.json`` the masks are counted."""
        entries, path = self._entries(name)
        try:
            ids = [self.object_ids.index(int(entry["obj_id"])) for entry in entries]
            rotations, translations = ([entry[key] for entry in entries] for key in ("cam_R_m2c", "cam_t_m2c"))
        except (KeyError, TypeError, ValueError) as error:
            listed = ", ".join(map(str, self.object_ids))
            raise ValueError(
                f"{path}: every entry of image {name} must have cam_R_m2c, cam_t_m2c and an obj_id among {listed}"
            ) from error
        poses = poses_in_millimetres(f"{path}: image {name}", rotations, translations)
        return GroundTruth(poses, self._visible(name, len(poses)), np.array(ids, dtype=np.int32), np.arange(len(poses)))

    def truth_bytes(self, name: str) -> bytes:
        """The picture's entries of ``scene_gt.json`` and ``scene_gt_info.json``."""
        entries, _ = self._entries(name)
        scene, _, image = name.partition("/")
        info = self._scene_files(scene).info
        return json.dumps([entries, None if info is None else info.get(str(int(image)))], sort_keys=True).encode()

    def picture_rule(self, name: str) -> str:
        """The picture's entry of ``scene_camera.json``."""
        return json.dumps(self._camera_entry(name)[1], sort_keys=True)

    def frame(self, name: str, labels: bool = True) -> Frame:
        """The picture of a scene; nothing in the format tells the bin from the parts but the masks."""
        path, entry = self._camera_entry(name)
        camera = self.camera(name)
        scale = number(path, entry, "depth_scale") / 1000
        depth = DepthCoding(0.0, scale, MISSING).decode(read_depth_counts(self._depth_file(name)))
        measured = depth[np.isfinite(depth)]
        middle = float(np.median(measured)) if len(measured) else 1.0
        if not NEAREST < middle < FARTHEST:
            looks = "metres" if middle <= NEAREST else "micrometres"
            raise ValueError(
                f"{path}: counts times depth_scale must be millimetres, got a median of {middle * 1000:.4g} in image "
                f"{name}: looks like {looks}"
            )
        truth = self.ground_truth(name) if labels else GroundTruth.none()
        instance = np.full(depth.shape, BACKGROUND, np.int32)
        if labels and self.has_labels:
            for row in range(len(truth.part_ids)):
                instance[self._mask(name, row, "mask_visib", camera)] = row
        return Frame(depth=depth, instance=instance, unknown_pixels=0, camera=camera, ground_truth=truth)

    def missing_files(self) -> dict[str, list[str]]:
        """See ``Dataset``."""
        missing: dict[str, list[str]] = {"depth": [], "gt": [], **({"labels": []} if self.has_labels else {})}
        masks: set[str] = set()
        scene = ""
        for name in self.names:
            folder = self._folders[name.partition("/")[0]]
            if folder.name != scene:
                scene = folder.name
                masks = {path.name for path in (folder / f"mask_visib{self._suffix}").glob("*.png")}
            image = name.partition("/")[2]
            if not any((folder / f"depth{self._suffix}" / f"{image}{s}").is_file() for s in (".png", ".tif")):
                missing["depth"].append(name)
            gt = self._scene_files(scene).gt
            if gt is None or str(int(image)) not in gt:
                missing["gt"].append(name)
            elif self.has_labels and any(f"{image}_{row:06d}.png" not in masks for row in range(len(self._rows(name)))):
                missing["labels"].append(name)
        return missing

    def _object_ids_in_use(self) -> tuple[int, ...]:
        entries = [entry for name in self.names for entry in self._rows(name)]
        return tuple(sorted({int(e["obj_id"]) for e in entries if isinstance(e, dict) and "obj_id" in e}))

    def _scene_files(self, scene: str) -> _SceneFiles:
        if self._loaded is None or self._loaded[0] != scene:
            paths = [self._folders[scene] / f"{stem}{self._suffix}.json" for stem in _STEMS]
            contents = [read_json(p, dict) if i == 0 or p.is_file() else None for i, p in enumerate(paths)]
            self._loaded = scene, _SceneFiles(contents[0] or {}, contents[1], contents[2])
        return self._loaded[1]

    def _camera_entry(self, name: str) -> tuple[Path, dict[str, Any]]:
        scene, _, image = self._checked(name).partition("/")
        path = self._folders[scene] / f"scene_camera{self._suffix}.json"
        entry = self._scene_files(scene).camera.get(str(int(image)))
        if not isinstance(entry, dict):
            raise ValueError(f"{path}: image {name} must have cam_K and depth_scale, got {entry!r:.60}")
        return path, entry

    def _rows(self, name: str) -> list[Any]:
        """Entries of a picture, none where there is no ground truth."""
        scene, _, image = self._checked(name).partition("/")
        entries = (self._scene_files(scene).gt or {}).get(str(int(image)), [])
        return entries if isinstance(entries, list) else []

    def _entries(self, name: str) -> tuple[list[Any], Path]:
        scene, _, image = self._checked(name).partition("/")
        path = self._folders[scene] / f"scene_gt{self._suffix}.json"
        gt = self._scene_files(scene).gt
        if gt is None or not isinstance(gt.get(str(int(image))), list):
            raise ValueError(f"{path}: there must be a list of poses for image {int(image)}, got none")
        return gt[str(int(image))], path

    def _visible(self, name: str, count: int) -> NDArray[np.float64]:
        scene, _, image = name.partition("/")
        path = self._folders[scene] / f"scene_gt_info{self._suffix}.json"
        info = self._scene_files(scene).info
        if info is None:
            camera = self.camera(name)
            seen, whole = (
                np.array([self._mask(name, row, kind, camera).sum() for row in range(count)], dtype=np.float64)
                for kind in ("mask_visib", "mask")
            )
            return np.clip(seen / np.maximum(whole, 1), 0, 1)
        entries = info.get(str(int(image)))
        if not isinstance(entries, list) or len(entries) != count or not all(isinstance(e, dict) for e in entries):
            raise ValueError(f"{path}: image {name} must have {count} entries, as many as poses")
        return np.clip([number(path, entry, "visib_fract") for entry in entries], 0.0, 1.0)

    def _mask(self, name: str, row: int, kind: str, camera: PinholeCamera) -> NDArray[np.bool_]:
        scene, _, image = name.partition("/")
        path = self._folders[scene] / f"{kind}{self._suffix}" / f"{image}_{row:06d}.png"
        mask = read_labels(path)
        camera.check_size(mask, str(path))
        return mask > 0

    def _depth_file(self, name: str) -> Path:
        scene, _, image = self._checked(name).partition("/")
        folder = self._folders[scene] / f"depth{self._suffix}"
        tif = folder / f"{image}.tif"
        return tif if tif.is_file() else folder / f"{image}.png"


_STEMS = ("scene_camera", "scene_gt", "scene_gt_info")


def _image_id(key: str) -> int:
    if not key.isdigit():
        raise ValueError(f"the keys of scene_camera.json must be image ids, got {key!r}")
    return int(key)
