"""Stored form of a scene: poses, visibility and camera, under a kilobyte; the points are ray-cast when needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from attentionvote.files import whole
from attentionvote.geometry.pose import matrix_from_quaternion, quaternion_from_matrix, transform
from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.camera import Camera
from attentionvote.simulation.raycast import BinSurface


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """A scene of a scene set.

    Attributes:
        cycle: the drop cycle it belongs to; scenes of one cycle resemble each other.
        drop_count: number of parts in the bin, I.
        camera_from_part: ``(I, 4, 4)`` float64 poses.
        visible_fraction: ``(I,)`` float64, visible share of an instance's own silhouette.
        camera: intrinsics.
        camera_from_bin: ``(4, 4)``; bin frame: middle of the floor, z up.
        bin_size: ``(3,)`` inner length, width, height in metres.
        friction: sliding friction coefficient of the cycle.
        scene_seed: seed for whatever is drawn anew for the scene (evaluation clouds, for example).
        part_ids: ``(I,)`` int32 which part of the bin's set each instance is; left out, all are the first.
        walls: shape of the bin's walls; None are thin and upright.
    """

    cycle: int
    drop_count: int
    camera_from_part: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    camera: Camera
    camera_from_bin: NDArray[np.float64]
    bin_size: NDArray[np.float64]
    friction: float
    scene_seed: int
    part_ids: NDArray[np.int32] = field(default=None)  # type: ignore[arg-type]  # None only until it is filled in
    walls: Walls | None = None

    def __post_init__(self) -> None:
        if self.part_ids is None:
            object.__setattr__(self, "part_ids", np.zeros(len(self.camera_from_part), dtype=np.int32))

    @property
    def bin_surface(self) -> BinSurface:
        """Floor and walls in the camera frame."""
        return BinSurface(self.bin_size, self.camera_from_bin, self.walls)


def _pack(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([quaternion_from_matrix(poses[..., :3, :3]), poses[..., :3, 3]], axis=-1)


def _unpack(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    return transform(matrix_from_quaternion(packed[..., :4]), packed[..., 4:])


def save_records(path: Path, records: Sequence[SceneRecord]) -> None:
    """Write the records of one cycle to ``path`` (.npz), whole or not at all."""
    fields = {
        "cycle": np.array([r.cycle for r in records], dtype=np.int64),
        "drop_count": np.array([r.drop_count for r in records], dtype=np.int64),
        "scene_seed": np.array([r.scene_seed for r in records], dtype=np.uint64),
        "friction": np.array([r.friction for r in records], dtype=np.float64),
        "camera": np.array([astuple(r.camera) for r in records], dtype=np.float64).reshape(-1, 6),
        "camera_from_bin": _pack(np.array([r.camera_from_bin for r in records]).reshape(-1, 4, 4)),
        "bin_size": np.array([r.bin_size for r in records], dtype=np.float64).reshape(-1, 3),
        "camera_from_part": _pack(np.concatenate([np.zeros((0, 4, 4)), *(r.camera_from_part for r in records)])),
        "visible_fraction": np.concatenate([np.zeros(0), *(r.visible_fraction for r in records)]),
    }
    part_ids = np.concatenate([np.zeros(0, dtype=np.int32), *(r.part_ids for r in records)])
    if part_ids.any():  # what holds one part only looks as it always did
        fields["part_ids"] = part_ids
    if walled := [astuple(r.walls) for r in records if r.walls is not None]:  # of a cycle all bins have the same walls
        fields["walls"] = np.array(walled, dtype=np.float64)
    whole(path, lambda temporary: np.savez(temporary, **fields))  # type: ignore[arg-type]


def load_records(path: Path) -> list[SceneRecord]:
    """Records written by :func:`save_records`.

    Raises:
        ValueError: when the file is not one of them.
    """
    try:
        with path.open("rb") as file, np.load(file) as stored:
            f = {name: stored[name] for name in stored.files}
        borders = np.cumsum(f["drop_count"])[:-1]
        poses = np.split(_unpack(f["camera_from_part"]), borders)
        visible = np.split(f["visible_fraction"], borders)
        part_ids = f.get("part_ids", np.zeros(len(f["visible_fraction"]), dtype=np.int32))
        kinds = np.split(part_ids.astype(np.int32), borders)
        cameras_from_bin = _unpack(f["camera_from_bin"])
        walls = [Walls(*map(float, row)) for row in f["walls"]] if "walls" in f else [None] * len(f["cycle"])
        return [
            SceneRecord(
                cycle=int(f["cycle"][i]),
                drop_count=int(f["drop_count"][i]),
                camera_from_part=poses[i],
                visible_fraction=visible[i],
                camera=Camera(int(f["camera"][i, 0]), int(f["camera"][i, 1]), *map(float, f["camera"][i, 2:])),
                camera_from_bin=cameras_from_bin[i],
                bin_size=f["bin_size"][i],
                friction=float(f["friction"][i]),
                scene_seed=int(f["scene_seed"][i]),
                part_ids=kinds[i],
                walls=walls[i],
            )
            for i in range(len(f["cycle"]))
        ]
    except (KeyError, IndexError, EOFError, OSError, ValueError, BadZipFile) as error:
        raise ValueError(
            f"{path} must be a shard of a scene set, but it cannot be read: delete it and generate again"
        ) from error
