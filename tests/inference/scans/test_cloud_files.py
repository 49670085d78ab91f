"""Clouds as arrays, and the choice of the reader by a file's first bytes."""

from __future__ import annotations

import io
import math
import mmap
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud
from attentionvote.inference.scans.limits import Budget

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


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8"])
@pytest.mark.parametrize("shape", [(50, 3), (5, 10, 3)])
@pytest.mark.parametrize("more", [0, 1, 3])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_flat_and_organised_with_further_columns(
    dtype: str, shape: tuple[int, ...], more: int, order: Literal["C", "F"]
) -> None:
    columns = np.concatenate([POINTS.reshape(shape), np.full((*shape[:-1], more), 7)], axis=-1)
    cloud = read_cloud(npy(np.asarray(columns, dtype, order=order)))
    np.testing.assert_array_equal(cloud, POINTS.reshape(shape), strict=True)


def test_half_precision_is_read_as_it_is() -> None:
    half = POINTS.astype(np.float16)
    np.testing.assert_array_equal(read_cloud(npy(half)), half.astype(np.float32), strict=True)


@pytest.mark.parametrize("names", ["xyz", "XYZ", "zYx"])
def test_records_are_read_by_the_names_of_their_fields(names: str) -> None:
    records = np.zeros(50, [("i", "u2"), *((name, "<f8") for name in names), ("label", "S3")])
    for name in names:
        records[name] = POINTS[:, "xyz".index(name.lower())]
    np.testing.assert_array_equal(read_cloud(npy(records)), POINTS)
    np.testing.assert_array_equal(read_cloud(npy(records.reshape(5, 10))), POINTS.reshape(5, 10, 3))


@given(
    nps.arrays(
        st.sampled_from(["<f4", "<f8", ">f4"]),
        st.tuples(st.integers(0, 8), st.just(3)),
        elements=st.sampled_from([0.0, -0.0, 0.5, np.nan, np.inf, -np.inf]),
    )
)
def test_whatever_is_not_measured_is_nan_and_nothing_else_is_changed(points: NDArray) -> None:
    cloud = read_cloud(npy(points))
    for row, point in zip(cloud, points, strict=True):
        if all(math.isfinite(value) for value in point) and any(value != 0 for value in point):
            assert row.tolist() == point.tolist()
        else:
            assert np.isnan(row).all()


def test_values_beyond_float32_are_missing() -> None:
    cloud = read_cloud(npy(np.array([[0, 0, 1e300], [1e-300, 0, 0], [0, 1, 2]])))
    np.testing.assert_array_equal(cloud, np.float32([[np.nan] * 3, [np.nan] * 3, [0, 1, 2]]))


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_content_of_every_kind_of_buffer_is_read_and_not_kept(kind: Callable[[bytes], Any]) -> None:
    content = kind(npy(POINTS))
    cloud = read_cloud(content)
    np.testing.assert_array_equal(cloud, POINTS)
    assert cloud.flags.owndata or cloud.base is not None
    if isinstance(content, bytearray):
        content.clear()  # fails while an array refers to it
    cloud[0] = 1


def test_a_mapped_file_is_read_without_a_copy_and_can_be_closed(tmp_path: Path) -> None:
    image = np.full((2048, 2448, 3), np.nan, np.float32)
    image[:100] = 0.5
    (tmp_path / "frame.npy").write_bytes(npy(image))
    with (tmp_path / "frame.npy").open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        tracemalloc.start()
        try:
            cloud = read_cloud(content, budget=Budget(most_seconds=60))
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    np.testing.assert_array_equal(cloud, image)
    assert peak < cloud.nbytes + 8 * MIB


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
    with pytest.raises(InputError, match=r"must unpack to at most 1000000 bytes, got more"):
        read_cloud(npz(points=np.zeros((100_000, 3))), "scan", budget=Budget(1_000_000))
    np.testing.assert_array_equal(read_cloud(npz(points=POINTS, unit=np.array("m"))), POINTS)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("scan.ply", PLY)
    with pytest.raises(InputError, match=r"must hold an array 'points', got scan\.ply: unpack it when it is a packed"):
        read_cloud(stream.getvalue())


def test_files_are_told_apart_by_content_and_named_by_path(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_bytes(PLY)
    for source in (path, str(path), PLY, PCD, b"# .PCD v0.7\n" + PCD, npy(np.float32([[1, 2, 3]]))):
        np.testing.assert_array_equal(read_cloud(source), [[1, 2, 3]])
    path.write_bytes(b"hello")
    with pytest.raises(
        InputError, match=rf"^{path} must be a point cloud as PLY, PCD, NPY, NPZ or XYZ text, got another kind of file"
    ):
        read_cloud(path)
    with pytest.raises(InputError, match=r"^upload must be a point cloud, got a PNG: a depth image needs its camera"):
        read_cloud(b"\x89PNG\r\n\x1a\n", "upload")
    with pytest.raises(InputError, match="but it is empty"):
        read_cloud(b"")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((5, 5), np.float32), r"must have shape \(P, 3\) or \(H, W, 3\), of 4 or 6 columns .*, got \(5, 5\)$"),
        (np.zeros((3, 50), np.float32), r"got \(3, 50\): transpose it"),
        (np.zeros(3, np.float32), r"got \(3,\)"),
        (np.zeros((2, 2, 2, 3), np.float32), r"got \(2, 2, 2, 3\)"),
        (np.zeros((5, 3), np.uint16), "must be floating-point metres, got uint16"),
        (np.array([{}]), "does not describe an array of plain numbers"),
        (np.zeros(5, [("x", "f4"), ("y", "f4")]), "records must have the fields x, y and z once each, got x, y"),
        (np.zeros(5, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("Z", "f4")]), "x, y and z once each, got x, y, z, Z"),
        (np.zeros(5, [("x", "f4", (2,)), ("y", "f4"), ("z", "f4")]), "x, y and z once each"),
        (np.zeros(5, [("x", "i4"), ("y", "f4"), ("z", "f4")]), "must be floating-point metres, got int32"),
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


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
@pytest.mark.parametrize(("ascii_", "compressed"), [(True, False), (False, False), (False, True)])
def test_what_open3d_writes_is_read_to_the_same_points(
    tmp_path: Path, suffix: str, ascii_: bool, compressed: bool
) -> None:
    from open3d import geometry, io, utility

    points = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32).astype(np.float64)
    cloud = geometry.PointCloud(utility.Vector3dVector(points))
    cloud.colors = utility.Vector3dVector(np.random.default_rng(1).random((300, 3)))
    cloud.normals = utility.Vector3dVector(points / np.linalg.norm(points, axis=1, keepdims=True))
    path = tmp_path / f"cloud.{suffix}"
    assert io.write_point_cloud(str(path), cloud, write_ascii=ascii_, compressed=compressed)
    read = read_cloud(path.read_bytes(), suffix)
    # As text Open3D writes six digits.
    np.testing.assert_allclose(read, points, rtol=1e-5 if ascii_ else 0, atol=1e-6 if ascii_ else 0)
