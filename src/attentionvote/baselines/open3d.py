"""Open3D's registration: the import, its point clouds, and one thread at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ADVICE = "run `make setup`, or install the extra: pip install '.[train]'"


def registration() -> ModuleType:
    """The module ``open3d``; two seconds of import, so only where something is to be registered.

    Raises:
        ValueError: when it is missing.
    """
    try:
        import open3d
    except ImportError as error:
        raise ValueError(f"the FPFH baseline needs open3d, but it cannot be imported ({error}): {_ADVICE}") from error
    module: ModuleType = open3d
    return module


@contextmanager
def threads(open3d: ModuleType, count: int) -> Iterator[None]:
    """Open3D on ``count`` threads; what was set before is set again."""
    before = open3d.utility.get_max_threads()
    open3d.utility.set_max_threads(count)
    try:
        yield
    finally:
        open3d.utility.set_max_threads(before)


def point_cloud(open3d: ModuleType, cloud: NDArray[np.floating]) -> Any:
    """Open3D's of points and normals ``(P, 6)``."""
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.asarray(cloud[:, :3], dtype=np.float64)))
    made.normals = open3d.utility.Vector3dVector(np.asarray(cloud[:, 3:], dtype=np.float64))
    return made


def open3d_version() -> str:
    """The installed version, without the import.

    Raises:
        ValueError: when it is missing.
    """
    for name in ("open3d-cpu", "open3d"):  # the same module, without and with CUDA
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    raise ValueError(f"the FPFH baseline needs open3d, but it is not installed: {_ADVICE}")
