"""Clouds as arrays, and the choice of the reader by a file's first bytes."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud

MIB = 1024 * 1024
POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
PLY = b"ply\nformat ascii 1.0\nelement vertex 1\n"
PLY += b"property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
PCD = (
    b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
)


def npy(array: NDArray) -> bytes:
    """A .npy file."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_arrays_flat_and_organised() -> None:
    np.testing.assert_array_equal(read_cloud(npy(POINTS.astype(">f8"))), POINTS)
    image = POINTS.reshape(5, 10, 3).copy()
    image[2, 3, 1] = np.nan
    np.testing.assert_array_equal(read_cloud(npy(image)), np.delete(POINTS, 23, axis=0))


def npz(**arrays: NDArray) -> bytes:
    """A .npz file, packed as numpy packs it."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def test_an_archive_gives_its_points() -> None:
    np.testing.assert_array_equal(read_cloud(npz(points=POINTS, confidence=np.zeros(3))), POINTS)
    with pytest.raises(InputError, match=r"its archive must hold an array 'points', got cloud, pose"):
        read_cloud(npz(cloud=POINTS, pose=np.eye(4)), "scan.npz")
    whole = npz(points=POINTS)
    for cut in (10, len(whole) // 2, len(whole) - 5):
        with pytest.raises(InputError, match="scan must be a point cloud, but"):
            read_cloud(whole[:cut], "scan")
    with pytest.raises(InputError, match=r"must have at most 96000000 bytes"):
        read_cloud(npz(points=np.zeros((4_000_001, 3))), "scan")


def test_files_are_told_apart_by_content_and_named_by_path(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_bytes(PLY)
    for source in (path, str(path), PLY, PCD, b"# .PCD v0.7\n" + PCD, npy(np.float32([[1, 2, 3]]))):
        np.testing.assert_array_equal(read_cloud(source), [[1, 2, 3]])
    path.write_bytes(b"hello")
    with pytest.raises(
        InputError, match=rf"^{path} must be a point cloud as PLY, PCD, NPY or NPZ, got another kind of file"
    ):
        read_cloud(path)
    with pytest.raises(InputError, match=r"^upload must be a point cloud, got a PNG: a depth image needs its camera"):
        read_cloud(b"\x89PNG\r\n\x1a\n", "upload")
    with pytest.raises(InputError, match="but it is empty"):
        read_cloud(b"")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((5, 4), np.float32), r"must have shape \(P, 3\) or \(H, W, 3\), got \(5, 4\)"),
        (np.zeros(3, np.float32), r"got \(3,\)"),
        (np.zeros((5, 3), np.uint16), "must be floating-point metres, got uint16"),
        (np.array([{}]), "does not describe an array of plain numbers"),
        (np.zeros((4_000_001, 3), np.float16), "at most 4000000 points, got 4000001"),
    ],
)
def test_an_array_that_is_no_cloud_is_one_sentence(array: NDArray, message: str) -> None:
    with pytest.raises(InputError, match=f"^scan.npy must be a point cloud, but .*{message}"):
        read_cloud(npy(array), "scan.npy")


@given(
    st.sampled_from([b"ply\n", b"# .PCD", b"VERSION .7\n", b"\x93NUMPY", b"\x93NUMPY\x01\x00"]), st.binary(max_size=200)
)
def test_no_bytes_raise_anything_else(magic: bytes, rest: bytes) -> None:
    with suppress(InputError):
        read_cloud(magic + rest)
