"""Writer of the BOP format, scenes and models: what ``bop.BopDataset``, ``bop_models`` and the BOP toolkit read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from attentionvote.datasets.bop import MISSING
from attentionvote.datasets.bop_models import MODELS_INFO, read_models_info
from attentionvote.datasets.depth_image import TOP, DepthCoding, PinholeCamera, write_image
from attentionvote.files import write_whole
from attentionvote.geometry.pose import transform
from attentionvote.part import Part

# Millimetres per count, the finest that holds the picture's depth is taken.
DEPTH_SCALES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


class BopSceneWriter:
    """Writes the pictures of one scene; its JSON files come with ``finish``, and without them it is none.

    Args:
        folder: ``<split>/000000``, created when missing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cameras: dict[str, Any] = {}
        self._gt: dict[str, Any] = {}
        self._info: dict[str, Any] = {}

    def write(
        self,
        image: int,
        camera: PinholeCamera,
        depth: NDArray[np.floating],
        instance: NDArray[np.integer],
        alone: NDArray[np.bool_],
        camera_from_part: NDArray[np.float64],
        visible_fraction: NDArray[np.float64],
        object_ids: Sequence[int],
    ) -> None:
        """Write one picture.

        Args:
            image: its number.
            camera: intrinsics.
            depth: ``(H, W)`` metres, not finite where nothing is measured.
            instance: ``(H, W)`` row of ``camera_from_part``, negative for none.
            alone: ``(I, H, W)`` silhouette of every instance as if it were alone.
            camera_from_part: ``(I, 4, 4)``, OpenCV camera frame, metres.
            visible_fraction: ``(I,)`` of the whole silhouette, also beyond the picture's border.
            object_ids: ``(I,)``.

        Raises:
            ValueError: with one sentence, when sizes disagree or the depth cannot be told; nothing is written then.
        """
        count = len(camera_from_part)
        camera.check_size(depth, "the depth image")
        camera.check_size(instance, "the image of instances")
        if not len(visible_fraction) == len(object_ids) == len(alone) == count or instance.max(initial=-1) >= count:
            raise ValueError(
                f"visibility, silhouettes, ids and instances must be of {count} parts, got {len(visible_fraction)}, "
                f"{len(alone)}, {len(object_ids)} and instance {instance.max(initial=-1)}"
            )
        farthest = 1000 * float(depth[np.isfinite(depth)].max(initial=0.0))
        scale = next((s for s in DEPTH_SCALES if farthest < s * TOP), DEPTH_SCALES[-1])
        counts = DepthCoding(0.0, scale / 1000, MISSING).encode(depth)
        write_image(self._folder / "depth" / f"{image:06d}.png", counts)
        gt, info = [], []
        for row, pose in enumerate(camera_from_part):
            seen = instance == row
            whole = alone[row] | seen
            name = f"{image:06d}_{row:06d}.png"
            write_image(self._folder / "mask" / name, np.where(whole, 255, 0).astype(np.uint8))
            write_image(self._folder / "mask_visib" / name, np.where(seen, 255, 0).astype(np.uint8))
            gt.append(
                {
                    "cam_R_m2c": pose[:3, :3].reshape(-1).tolist(),
                    "cam_t_m2c": (pose[:3, 3] * 1000).tolist(),
                    "obj_id": int(object_ids[row]),
                }
            )
            visible, pixels = float(visible_fraction[row]), int(seen.sum())
            info.append(
                {
                    "bbox_obj": _box(whole),
                    "bbox_visib": _box(seen),
                    # The silhouette goes on beyond the border, where the masks cannot show it.
                    "px_count_all": max(int(whole.sum()), round(pixels / visible) if visible > 0 else 0),
                    "px_count_valid": int((whole & np.isfinite(depth)).sum()),
                    "px_count_visib": pixels,
                    "visib_fract": visible,
                }
            )
        key = str(image)
        matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        self._cameras[key] = {"cam_K": matrix, "depth_scale": scale}
        self._gt[key], self._info[key] = gt, info

    def finish(self) -> None:
        """Write ``scene_gt.json``, ``scene_gt_info.json`` and, last, ``scene_camera.json``."""
        for name, content in (("gt", self._gt), ("gt_info", self._info), ("camera", self._cameras)):
            write_whole(self._folder / f"scene_{name}.json", json.dumps(content, indent=1) + "\n")


def write_models(folder: Path, parts: Mapping[int, Part]) -> None:
    """Write ``models_info.json`` and a PLY in millimetres of every part, by object id.

    Raises:
        ValueError: with one sentence, when the reader would not take the models back.
    """
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
    read_models_info(folder / MODELS_INFO)


def _box(mask: NDArray[np.bool_]) -> list[int]:
    """``x, y, width, height`` of a mask ``(H, W)`` in pixels, -1 without a pixel."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return [-1, -1, -1, -1]
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)]


def _ply(part: Part) -> str:
    head = ["ply", "format ascii 1.0", f"element vertex {len(part.vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(part.faces)}", "property list uchar int vertex_indices", "end_header"]
    vertices = [" ".join(f"{value:.6g}" for value in vertex) for vertex in part.vertices * 1000]
    faces = [f"3 {a} {b} {c}" for a, b, c in part.faces]
    return "\n".join([*head, *vertices, *faces]) + "\n"
