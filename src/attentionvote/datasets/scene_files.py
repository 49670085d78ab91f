"""Scenes of one object, each with files of its own: what the readers of IPA and Sileane share."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.datasets.dataset import Dataset, GroundTruth, rows_of_labels
from attentionvote.datasets.depth_image import DepthCoding, read_depth_counts, read_labels
from attentionvote.scene import BACKGROUND


class SceneFiles(Dataset):
    """A dataset of a file of each kind a scene."""

    _files: dict[str, dict[str, Path]]  # by kind (depth, gt, labels) and the scene's name

    @abstractmethod
    def _coding(self, name: str) -> DepthCoding:
        """What the counts of a scene's depth image mean."""

    def truth_bytes(self, name: str) -> bytes:
        """The file of the poses."""
        return self._file(name, "gt").read_bytes()

    def missing_files(self) -> dict[str, list[str]]:
        """See ``Dataset``; labels are missed only when some are there."""
        kinds = ["depth", "gt", *(["labels"] if self.has_labels else [])]
        return {kind: [name for name in self.names if name not in self._files[kind]] for kind in kinds}

    def _file(self, name: str, kind: str) -> Path:
        path = self._files[kind].get(self._checked(name))
        if path is None:
            raise ValueError(f"{self.directory}: scene {name} has no file of its {kind}")
        return path

    def _depth(self, name: str) -> NDArray[np.float64]:
        path = self._file(name, "depth")
        counts = read_depth_counts(path)
        self.camera(name).check_size(counts, str(path))
        return self._coding(name).decode(counts)

    def _seen(
        self, name: str, labels: bool, background: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], GroundTruth, NDArray[np.int32], int]:
        """Depth, ground truth, row of it at every pixel, and pixels of unknown labels; see ``frame``."""
        depth = self._depth(name)
        truth = self.ground_truth(name) if labels else GroundTruth.none()
        if not labels or not self.has_labels:
            return depth, truth, np.full(depth.shape, BACKGROUND, np.int32), 0
        path = self._file(name, "labels")
        image = read_labels(path)
        self.camera(name).check_size(image, str(path))
        return depth, truth, *rows_of_labels(image, truth.label_ids, background)
