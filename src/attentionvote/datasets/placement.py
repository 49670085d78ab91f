"""Do poses lie on the points of their instances? Tells a mix-up of frames from distances alone, without a mesh.

A part's own origin is in or near it, so its points are nearer to the pose's origin than D. Where files and reader
disagree about the frame, most are not; a few usual mistakes are tried to say which one it was. A rotation about the
origin (R read row by row instead of column by column, say) moves no origin and is not noticed here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import inverse
from attentionvote.scene import Scene

# Fewer points say little about where a part is; more than so many say no more.
LEAST_POINTS, MOST_POINTS = 20, 64
# Labels of a real set have mistakes; a wrong frame has them everywhere.
TOLERATED_SHARE = 0.05


class Placement(NamedTuple):
    """How many instances were looked at, how many lie off their points, and what would put them there, or ''."""

    looked_at: int
    misplaced: int
    remedy: str

    @property
    def is_wrong(self) -> bool:
        """Whether so many are off that it is no slip of single labels."""
        return self.misplaced > TOLERATED_SHARE * self.looked_at


class PlacementCheck:
    """Gathers instances scene by scene and judges them together.

    Args:
        diameters: D of every part in metres; where it is None the largest extent of any instance's points stands in.
        camera_from_file: ``(4, 4)``, what takes poses as they stand in the file into the camera's frame.
    """

    def __init__(
        self, diameters: tuple[float | None, ...], camera_from_file: NDArray[np.float64] | None = None
    ) -> None:
        self._diameters = diameters
        self._camera_from_file = np.eye(4) if camera_from_file is None else camera_from_file
        self._points: list[NDArray[np.float64]] = []
        self._poses: list[NDArray[np.float64]] = []
        self._parts: list[int] = []

    def add(self, scene: Scene) -> None:
        """Take a scene's instances; those with few points are left out."""
        order = np.argsort(scene.instance_ids, kind="stable")
        ids = scene.instance_ids[order]
        for row, pose in enumerate(scene.camera_from_part):
            first, last = np.searchsorted(ids, (row, row + 1))
            if last - first >= LEAST_POINTS:
                # The points of a scene are in random order, so the first ones are a fair sample.
                self._points.append(scene.points[order[first : min(last, first + MOST_POINTS)]].astype(np.float64))
                self._poses.append(pose)
                self._parts.append(int(scene.part_ids[row]))

    def judge(self) -> Placement:
        """The verdict about everything that was added."""
        if not self._poses:
            return Placement(0, 0, "")
        poses, limits = np.array(self._poses), self._limits()
        origin = poses[:, :3, 3]
        misplaced = self._off(origin, limits)
        turn = self._camera_from_file
        usual = {
            "x and y negated": origin * (-1, -1, 1),
            "y and z negated": origin * (1, -1, -1),
            "x and z negated": origin * (-1, 1, -1),
            "poses left as they stand in the file": (inverse(turn) @ poses)[:, :3, 3],
            "the poses inverted": (turn @ inverse(poses) @ turn)[:, :3, 3],
            "translations divided by 1000": origin / 1000,
            "translations multiplied by 1000": origin * 1000,
        }
        remedy = ""
        if misplaced > TOLERATED_SHARE * len(poses):
            off = {what: self._off(other, limits) for what, other in usual.items()}
            best = min(off, key=lambda what: off[what])
            remedy = best if off[best] <= TOLERATED_SHARE * len(poses) else ""
        return Placement(len(poses), misplaced, remedy)

    def _limits(self) -> NDArray[np.float64]:
        """D of every instance's part, known or the largest extent seen of any of it."""
        extents = np.array([np.linalg.norm(np.ptp(points, axis=0)) for points in self._points])
        parts = np.array(self._parts)
        diameters = [self._diameters[part] if part < len(self._diameters) else None for part in range(parts.max() + 1)]
        return np.array([diameters[part] or extents[parts == part].max() for part in self._parts])

    def _off(self, origins: NDArray[np.float64], limits: NDArray[np.float64]) -> int:
        distances = [
            np.median(np.linalg.norm(points - origin, axis=1))
            for points, origin in zip(self._points, origins, strict=True)
        ]
        return int((np.array(distances) > limits).sum())
