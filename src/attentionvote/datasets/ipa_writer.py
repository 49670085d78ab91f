"""Writer of the IPA layout: what ``ipa.IpaDataset`` and other people's IPA readers read."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.depth_image import DepthCoding, PinholeCamera, write_image
from attentionvote.datasets.ipa import (
    COLUMNS,
    DEPTH_SUFFIX,
    LABEL_OF_BIN,
    LABEL_OF_NOTHING,
    LABEL_SUFFIX,
    MISSING,
    OPENCV_FROM_IPA,
)
from attentionvote.files import write_whole


class IpaWriter:
    """Writes scenes of one object and split; ``parameter.json`` comes first.

    Args:
        folder: ``<split>/<Object>``, created when missing.
        part_name: what the column ``class`` says.
        camera: of every picture. The layout knows one focal length, and a principal point that lies at
            res_big / 2 - 0.5 - offset with whole offsets: both coordinates at whole pixels, or both at halves.
        clip_start, clip_end: metres; every depth must lie between them.

    Raises:
        ValueError: with one sentence, when the layout cannot say it.
    """

    def __init__(self, folder: Path, part_name: str, camera: PinholeCamera, clip_start: float, clip_end: float) -> None:
        self._folder, self._part_name, self._camera = folder, part_name, camera
        self._coding = DepthCoding.between(clip_start, clip_end, MISSING)
        size, offsets = big_picture(camera)
        parameters = {
            "resolutionX": camera.width,
            "resolutionY": camera.height,
            "resolution_big": size,
            "perspectiveAngle": float(np.degrees(2 * np.arctan(size / (2 * camera.fx)))),
            "pixelOffset_X_KoSyTopLeft": offsets[0],
            "pixelOffset_Y_KoSyTopLeft": offsets[1],
            "clip_start": clip_start,
            "clip_end": clip_end,
            "location": [0.0, 0.0, 0.0],
            "rotation": [1.0, 0.0, 0.0, 0.0],
        }
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "parameter.json", json.dumps(parameters, indent=2) + "\n")

    def write(
        self,
        cycle: int,
        depth: NDArray[np.floating],
        instance: NDArray[np.integer],
        camera_from_part: NDArray[np.float64],
        visible_fraction: NDArray[np.float64],
        camera_from_bin: NDArray[np.float64],
    ) -> str:
        """Write one scene and return its name; without parts it is the cycle's picture of the empty bin.

        Args:
            cycle: number of the drop cycle.
            depth: ``(H, W)`` metres, not finite where nothing is measured.
            instance: ``(H, W)`` row of ``camera_from_part``, negative for none.
            camera_from_part: ``(I, 4, 4)``, OpenCV camera frame.
            visible_fraction: ``(I,)``.
            camera_from_bin: ``(4, 4)``, the first row of the ground truth.

        Raises:
            ValueError: with one sentence, when the layout cannot hold it; nothing of the scene is written then.
        """
        count = len(camera_from_part)
        self._camera.check_size(depth, "the depth image")
        self._camera.check_size(instance, "the image of instances")
        if count >= LABEL_OF_NOTHING:
            raise ValueError(f"an IPA scene must have at most {LABEL_OF_NOTHING - 1} parts, got {count}")
        if len(visible_fraction) != count or instance.max(initial=-1) >= count:
            raise ValueError(
                f"visibility and instances must be of {count} parts, got {len(visible_fraction)} values "
                f"and instance {instance.max()}"
            )
        counts = self._coding.encode(depth)
        labels = np.where(instance >= 0, instance + 1, np.where(np.isfinite(depth), LABEL_OF_BIN, LABEL_OF_NOTHING))
        name = f"cycle_{cycle:04d}/{count:03d}"
        write_image(self._folder / "p_depth" / f"{name}{DEPTH_SUFFIX}", counts)
        write_image(self._folder / "p_segmentation" / f"{name}{LABEL_SUFFIX}", labels.astype(np.uint8))
        poses = OPENCV_FROM_IPA @ np.concatenate([camera_from_bin[None], camera_from_part])
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(COLUMNS)
        for index, (pose, visible) in enumerate(zip(poses, [1.0, *visible_fraction], strict=True)):
            # R column by column; the orthographic visibility is not measured and repeats the other.
            numbers = [*pose[:3, 3], *pose[:3, :3].T.reshape(-1), visible, visible]
            rows.writerow([index, self._part_name if index else "bin", *(repr(float(v)) for v in numbers)])
        path = self._folder / "gt" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.getvalue())
        return name


def big_picture(camera: PinholeCamera) -> tuple[int, tuple[int, int]]:
    """Side of the square picture about the optical axis that holds the camera's, and where in it that one begins.

    Raises:
        ValueError: with one sentence, when the layout cannot describe the camera.
    """
    if not np.isclose(camera.fx, camera.fy, rtol=1e-9):
        raise ValueError(f"an IPA camera must have one focal length, got fx {camera.fx} and fy {camera.fy}")
    twice = np.array([2 * camera.cx + 1, 2 * camera.cy + 1])
    whole = np.rint(twice).astype(int)
    if np.abs(twice - whole).max() > 1e-6 or whole[0] % 2 != whole[1] % 2:
        raise ValueError(
            "an IPA camera must have cx and cy both at whole or both at half pixels, "
            f"got {camera.cx} and {camera.cy}: round them"
        )
    right = 2 * np.array([camera.width, camera.height]) - whole
    size = int(max(*whole, *right))
    size += int(size - whole[0]) % 2
    offset_x, offset_y = ((size - whole) // 2).tolist()
    return size, (offset_x, offset_y)
