"""Which points and neighbours the network sees: farthest-point order, ball query, nearest three.

Each operator has a C implementation (``pointops.c``, compiled once per machine with the system's C compiler,
no torch headers, no CUDA) and a slow numpy reference in ``sampling_reference``, which is its oracle in the
tests and takes its place where no compiler is found. Both return the same indices.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import sampling_reference

_FLAGS = ("-O3", "-std=c99", "-ffinite-math-only", "-fno-signed-zeros", "-shared", "-fPIC")


def farthest_point_order(points: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Indices ``(count,)`` of points so that each is the farthest from all before it; starts at index 0.

    Exact, ties to the lowest index, so the first m of the order are what a shorter call would return: every
    level of the network is a prefix of one order.

    Args:
        points: ``(P, 3)`` metres.
        count: number of points to choose, at most P.

    Raises:
        ValueError: when ``points`` is not ``(P, 3)`` and finite or ``count`` is not in 1..P.
    """
    xyz = _checked("points", points)
    if not 1 <= count <= len(xyz):
        raise ValueError(f"count must lie in 1..{len(xyz)} (the number of points), got {count}")
    library = compiled_library()
    if library is None:
        return sampling_reference.farthest_point_order(xyz, count)
    order = np.empty(count, dtype=np.int32)
    _call(library.farthest_point_order, xyz, len(xyz), count, order)
    return order.astype(np.int64)


def ball_query(
    points: NDArray[np.float32], centers: NDArray[np.float32], radius: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first ``count`` points in index order within ``radius`` of each centre (PointNet++'s meaning).

    Because the order of a sample's points is random this is a uniform sample of the ball; the nearest
    ``count`` points would be another network.

    Args:
        points: ``(P, 3)`` metres.
        centers: ``(C, 3)`` metres.
        radius: metres; a point at exactly this distance is inside.
        count: neighbours per centre.

    Returns:
        Indices ``(C, count)``, short balls padded with their first index (0 when empty), and the number of
        real neighbours ``(C,)``.

    Raises:
        ValueError: on shapes, non-finite points, or a radius or count that is not positive.
    """
    xyz, middle = _checked("points", points), _checked("centers", centers, empty=True)
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be a positive number of metres, got {radius}")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    library = compiled_library()
    if library is None:
        return sampling_reference.ball_query(xyz, middle, radius, count)
    neighbors = np.empty((len(middle), count), dtype=np.int32)
    found = np.empty(len(middle), dtype=np.int32)
    _call(library.ball_query, xyz, len(xyz), middle, len(middle), ctypes.c_float(radius), count, neighbors, found)
    return neighbors.astype(np.int64), found.astype(np.int64)


def three_nearest(
    sources: NDArray[np.float32], targets: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The three nearest sources of every target, nearest first, and their distances.

    Args:
        sources: ``(S, 3)`` metres; with fewer than three the last one is repeated.
        targets: ``(T, 3)`` metres.

    Returns:
        Indices ``(T, 3)`` and distances ``(T, 3)`` in metres.
    """
    xyz, goal = _checked("sources", sources), _checked("targets", targets, empty=True)
    library = compiled_library()
    if library is None:
        return sampling_reference.three_nearest(xyz, goal)
    neighbors = np.empty((len(goal), 3), dtype=np.int32)
    squared = np.empty((len(goal), 3), dtype=np.float32)
    _call(library.three_nearest, xyz, len(xyz), goal, len(goal), neighbors, squared)
    return neighbors.astype(np.int64), np.sqrt(squared)


@functools.cache
def compiled_library() -> ctypes.CDLL | None:
    """The compiled operators, or None (with one warning) where there is no C compiler."""
    source = resources.files("attentionvote.geometry").joinpath("pointops.c").read_bytes()
    key = hashlib.sha256(b"\0".join([source, *(f.encode() for f in _FLAGS), platform.machine().encode()])).hexdigest()
    path = cache_folder() / f"pointops-{key[:16]}.so"
    if not path.exists():
        compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            warnings.warn(
                "no C compiler found, point operators run in numpy and are about 50 times slower: install gcc",
                stacklevel=2,
            )
            return None
        _compile(compiler, source, path)
    return ctypes.CDLL(str(path))


def cache_folder() -> Path:
    """Where things computed once per machine are kept: ``ATTENTIONVOTE_CACHE``, else the user's cache folder."""
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "attentionvote"
    return Path(os.environ.get("ATTENTIONVOTE_CACHE", default))


def _compile(compiler: str, source: bytes, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        c_file, library = Path(folder, "pointops.c"), Path(folder, "pointops.so")
        c_file.write_bytes(source)
        command = [compiler, *_FLAGS, str(c_file), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{compiler} could not compile the point operators: {done.stderr.strip()[:500]}")
        library.replace(path)  # atomic: two processes may compile at once


def _call(function: ctypes._FuncPointer, *arguments: object) -> None:
    pointers = [ctypes.c_void_p(a.ctypes.data) if isinstance(a, np.ndarray) else a for a in arguments]
    if function(*pointers):
        raise MemoryError("the point operators ran out of memory")


def _checked(name: str, points: NDArray, empty: bool = False) -> NDArray[np.float32]:
    xyz = np.ascontiguousarray(points, dtype=np.float32)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or (len(xyz) == 0 and not empty):
        raise ValueError(f"{name} must have shape (P, 3) with P >= 1, got {xyz.shape}")
    if not np.isfinite(xyz).all():
        raise ValueError(f"{name} must be finite, got {int((~np.isfinite(xyz)).any(axis=1).sum())} with NaN or inf")
    return xyz
