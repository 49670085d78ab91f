"""OpenCV's surface matching: the import, its clouds, and one thread at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
from numpy.typing import NDArray


def surface_matching() -> ModuleType:
    """The module ``cv2`` with its part ``ppf_match_3d``.

    Raises:
        ValueError: when OpenCV is missing, or is a build without the contributed modules.
    """
    advice = "run `make setup`, or install the extra: pip install '.[benchmark]'"
    try:
        import cv2
    except ImportError as error:
        raise ValueError(
            f"the PPF baseline needs opencv-contrib-python-headless, but cv2 is missing: {advice}"
        ) from error
    if not hasattr(cv2, "ppf_match_3d"):
        raise ValueError(
            f"the PPF baseline needs a cv2 with the module ppf_match_3d, but OpenCV {cv2.__version__} here is built "
            f"without it (opencv-python instead of opencv-contrib-python-headless): {advice}"
        )
    return cv2


@contextmanager
def threads(cv2: ModuleType, count: int) -> Iterator[None]:
    """OpenCV on ``count`` threads; what was set before is set again."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def thinned(cloud: NDArray[np.float32], voxel: float) -> NDArray[np.float32]:
    """One point a voxel ``(Q, 6)`` of a cloud ``(P, 6)`` of points and unit normals: their means.

    The two sides of a thin wall stay two points: the direction that a normal has most of belongs to the cell.
    """
    cell = np.floor(cloud[:, :3].astype(np.float64) / voxel).astype(np.int64)
    cell -= cell.min(axis=0)
    normals = cloud[:, 3:]
    main = np.abs(normals).argmax(axis=1)
    side = 2 * main + (np.take_along_axis(normals, main[:, None], axis=1)[:, 0] > 0)
    _, inverse, count = np.unique(np.c_[cell, side], axis=0, return_inverse=True, return_counts=True)
    # bincount adds in double precision and in the order of the points: the same cloud, the same bits.
    mean = np.stack([np.bincount(inverse, weights=cloud[:, i]) for i in range(6)], axis=1) / count[:, None]
    mean[:, 3:] /= np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    return mean.astype(np.float32)
