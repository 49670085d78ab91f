"""PLY in every order and layout exactly, every damage in one sentence, no memory for a lying header."""

from __future__ import annotations

import io
import struct
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud
from attentionvote.inference.scans.limits import Budget

MIB = 1024 * 1024
POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
pytestmark = pytest.mark.usefixtures("way")
TEXT = {"f": "%.9g", "d": "%.17g", "B": "%d", "i": "%d"}


def ply(points: NDArray, order: str, fields: str = "xyz", newline: str = "\n", real: str = "float") -> bytes:
    """A PLY file with these vertex properties (x, y, z real; n a float; r a uchar) and one face."""
    kinds = {"x": real, "y": real, "z": real, "n": "float", "r": "uchar"}
    header = ["ply", f"format {order} 1.0", "comment end_header of a comment", f"element vertex {len(points)}"]
    header += [f"property {kinds[name]} {name}" for name in fields]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    codes = [{"float": "f", "double": "d", "uchar": "B"}[kinds[name]] for name in fields]
    other = {"n": 0.25, "r": 7}
    rows = [[other.get(name, point["xyz".find(name)]) for name in fields] for point in points]
    if order == "ascii":
        lines = [" ".join(TEXT[code] % value for code, value in zip(codes, row, strict=True)) for row in rows]
        return newline.join([*header, *lines, "3 0 1 2", ""]).encode()
    pack = struct.Struct(PLY_ORDERS[order] + "".join(codes))
    body = b"".join(pack.pack(*row) for row in rows) + struct.pack(PLY_ORDERS[order] + "B3i", 3, 0, 1, 2)
    return newline.join([*header, ""]).encode() + body


@pytest.mark.parametrize("real", ["float", "double"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("fields", ["xyz", "nxryz", "zryx"])
@pytest.mark.parametrize("order", PLY_ORDERS)
def test_ply_in_every_order(order: str, fields: str, newline: str, real: str) -> None:
    cloud = read_cloud(ply(POINTS, order, fields, newline, real))
    assert cloud.dtype == np.float32
    np.testing.assert_array_equal(cloud, POINTS)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_of_another_library(encoding: str) -> None:
    written = trimesh.PointCloud(POINTS.astype(np.float64), colors=np.full((50, 4), 200, np.uint8))
    content = written.export(file_type="ply", encoding=encoding)
    np.testing.assert_allclose(read_cloud(content), POINTS, atol=1e-6)
    mesh = trimesh.creation.box()
    content = mesh.export(file_type="ply", encoding=encoding, vertex_normal=True)
    np.testing.assert_allclose(read_cloud(content), mesh.vertices, atol=1e-6)


def test_ply_elements_before_the_vertices_are_skipped() -> None:
    header = b"ply\nformat %s 1.0\nelement camera 2\nproperty float a\nproperty short b\n"
    header += b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    assert read_cloud(header % b"ascii" + b"1 2\n\n3 4\n0.5 1 2\n").tolist() == [[0.5, 1, 2]]
    body = struct.pack("<fhfhfff", 1, 2, 3, 4, 0.5, 1, 2)
    assert read_cloud(header % b"binary_little_endian" + body).tolist() == [[0.5, 1, 2]]


def test_names_of_axes_may_be_capitals() -> None:
    content = BINARY.replace(b"float x", b"float X").replace(b"float y", b"float Y").replace(b"float z", b"float Z")
    np.testing.assert_array_equal(read_cloud(content), POINTS)


@pytest.mark.parametrize("order", PLY_ORDERS)
def test_missing_points_keep_their_places(order: str) -> None:
    points, expected = POINTS.copy(), POINTS.copy()
    points[3], points[7], points[20] = (np.nan, np.nan, 1), (0.1, np.inf, 0.5), (0, -0.0, 0)
    expected[[3, 7, 20]] = np.nan
    np.testing.assert_array_equal(read_cloud(ply(points, order)), expected)


@pytest.mark.parametrize("order", PLY_ORDERS)
def test_more_than_the_header_promises_is_refused_where_nothing_may_follow(order: str) -> None:
    with_face = ply(POINTS, order)
    header, _, body = with_face.partition(b"element face 1\nproperty list uchar int vertex_indices\n")
    alone = (header + body)[: -8 if order == "ascii" else -13]
    np.testing.assert_array_equal(read_cloud(alone), POINTS)
    np.testing.assert_array_equal(read_cloud(alone + b"\n\n" + bytes(100)), POINTS)
    for more in (b"1 2 3\n", POINTS[:1].tobytes()):
        with pytest.raises(InputError, match="promises 50 vertices and nothing else, but more follows them"):
            read_cloud(alone + more)


def test_points_of_a_file_that_promises_none_are_refused() -> None:
    header = (
        b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert read_cloud(header + b"\n").shape == (0, 3)
    with pytest.raises(InputError, match="promises 0 vertices and nothing else, but more follows them"):
        read_cloud(header + b"1 2 3\n")


def test_lists_before_the_vertices_are_skipped_in_a_text_only() -> None:
    header = b"ply\nformat %s 1.0\nelement strip 2\nproperty list uchar int a\n"
    header += b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    assert read_cloud(header % b"ascii" + b"2 1 2\n0\n0.5 1 2\n").tolist() == [[0.5, 1, 2]]
    with pytest.raises(InputError, match="its element strip must have no list property unless it follows the vertices"):
        read_cloud(header % b"binary_little_endian" + bytes(40))


@pytest.mark.parametrize("order", PLY_ORDERS)
def test_an_empty_cloud_is_a_cloud(order: str) -> None:
    assert read_cloud(ply(POINTS[:0], order)).shape == (0, 3)


ASCII, BINARY = ply(POINTS, "ascii"), ply(POINTS, "binary_little_endian")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\n", "its header has no end_header"),
        (b"ply\nformat ascii 1.0\nend_header\n", "its header has no element vertex"),
        (BINARY.replace(b"format binary_little_endian 1.0\n", b""), "its header must name a format, one of ascii"),
        (BINARY.replace(b"binary_little_endian", b"binary_middle_endian"), "has the line 'format binary_middle_endian"),
        (BINARY.replace(b"float z", b"float w"), "its vertices must have x, y and z, got no z"),
        (BINARY.replace(b"float z", b"float y"), "its element vertex has the property 'y' twice"),
        (BINARY.replace(b"float z", b"list uchar int z"), "must have no list property"),
        (ASCII.replace(b"float z", b"list uchar int z"), "must have no list property"),
        (BINARY.replace(b"vertex 50", b"vertex 5000000"), "promises 5000000 vertices of 12 bytes, but only"),
        (BINARY.replace(b"property float z", b"property float z\nproperty float Z"), "must have z once, got z and Z"),
        (BINARY.replace(b"vertex 50", b"vertex -5"), "has the line 'element vertex -5'"),
        (BINARY.replace(b"vertex 50", b"vertex " + b"9" * 30), "has the line 'element vertex 999"),
        (BINARY.replace(b"vertex 50", b"vertex 52"), "promises 52 vertices of 12 bytes, but only 613 bytes follow"),
        (ASCII.replace(b"vertex 50", b"vertex 100000"), "promises 100000 points, but only"),
        (ASCII[: ASCII.rfind(b"\n", 0, -20)].rsplit(b"\n", 3)[0], "promises 50 points, but only 4[0-9] follow"),
        (
            ASCII.replace(b"property float z", b"property float z\nproperty float w"),
            "must be rows of 4 numbers, got rows of 3",
        ),
        (ASCII.replace(b"end_header\n", b"end_header\nx y z\n"), "must be rows of 3 numbers, got something else"),
        (b"ply\n" + b"comment\n" * 3000 + b"end_header\n", "at most 2000 lines"),
        (b"ply\n" + b"x" * MIB, "its header has no end_header"),
    ],
)
def test_a_damaged_ply_is_one_sentence(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=f"^scan.ply must be a point cloud, but .*{message}"):
        read_cloud(content, "scan.ply")


LYING = [
    BINARY.replace(b"vertex 50", b"vertex 4000000"),
    ASCII.replace(b"vertex 50", b"vertex 4000000"),
    BINARY.replace(b"element vertex", b"element camera 999999999999999\nproperty double a\nelement vertex"),
    ASCII.replace(b"element vertex", b"element camera 999999999999999\nproperty double a\nelement vertex"),
]


@pytest.mark.parametrize("content", LYING)
def test_a_lying_header_reserves_no_memory_and_takes_no_time(content: bytes) -> None:
    start = time.process_time()
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"promises|early|within"):
            read_cloud(content)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()
    assert time.process_time() - start < 2


@pytest.mark.parametrize("rows", [65_535, 65_536, 65_537, 140_000])
def test_long_texts_are_read_in_blocks(rows: int) -> None:
    points = np.arange(3 * rows, dtype=np.float32).reshape(-1, 3)
    stream = io.BytesIO()
    np.savetxt(stream, points, fmt="%d")
    header = ply(points[:0], "ascii").decode().replace("vertex 0", f"vertex {rows}").split("3 0 1 2")[0]
    np.testing.assert_array_equal(
        read_cloud(header.encode() + stream.getvalue(), budget=Budget(most_seconds=60)), points
    )
    with pytest.raises(InputError, match=f"promises {rows} points, but only {rows - 1} follow"):
        read_cloud(
            header.encode() + stream.getvalue().rstrip().rsplit(b"\n", 1)[0] + b"\n" * 10,
            budget=Budget(most_seconds=60),
        )


Damage = Callable[[bytes, st.DataObject], bytes]
WHOLE = [ply(POINTS[:4], order, "nxryz") for order in PLY_ORDERS]


@given(st.sampled_from(WHOLE), st.data())
def test_no_damaged_file_raises_anything_else(damaged: Damage, whole: bytes, data: st.DataObject) -> None:
    with suppress(InputError):
        cloud = read_cloud(damaged(whole, data))
        assert cloud.ndim == 2
        assert cloud.shape[1] == 3
