"""Clouds from files: every kind and layout exactly, every damage in one sentence, no memory for a lying header."""

from __future__ import annotations

import io
import struct
import time
import tracemalloc
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.inference.cloud_files import read_cloud
from attentionvote.inference.errors import InputError

MIB = 1024 * 1024
POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TEXT = {"f": "%.9g", "d": "%.17g", "B": "%d", "i": "%d"}


def npy(array: NDArray) -> bytes:
    """A .npy file."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


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
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
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


def lzf_literals(data: bytes) -> bytes:
    """Data packed without any repetition: what a compressor writes when it finds none."""
    return b"".join(bytes([len(part) - 1]) + part for part in (data[i : i + 32] for i in range(0, len(data), 32)))


def pcd(points: NDArray, kind: str, fields: str = "xyz", height: int = 1, real: int = 4, newline: str = "\n") -> bytes:
    """A PCD file with these fields (x, y, z real; r a uint of 1 byte; n three floats)."""
    sizes = {"r": 1, "n": 4}
    counts = [3 if name == "n" else 1 for name in fields]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(fields),
        "SIZE " + " ".join(str(sizes.get(name, real)) for name in fields),
        "TYPE " + " ".join("U" if name == "r" else "F" for name in fields),
        "COUNT " + " ".join(map(str, counts)),
        f"WIDTH {len(points) // height}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        f"DATA {kind}",
        "",
    ]
    header = newline.join(lines).encode()
    code = {4: "<f4", 8: "<f8"}[real]
    columns = {
        name: np.full((len(points), 1), 7, "u1")
        if name == "r"
        else np.full((len(points), 3), 0.5, "<f4")
        if name == "n"
        else points[:, ["xyz".index(name)]].astype(code)
        for name in fields
    }
    if kind == "ascii":
        rows = np.concatenate([columns[name].astype(np.float64) for name in fields], axis=1)
        return header + newline.join(" ".join(f"{v:.9g}" for v in row) for row in rows).encode()
    if kind == "binary":
        return header + b"".join(b"".join(columns[n][i].tobytes() for n in fields) for i in range(len(points)))
    data = b"".join(columns[name].tobytes() for name in fields)
    packed = lzf_literals(data)
    return header + struct.pack("<II", len(packed), len(data)) + packed + bytes(5)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("real", [4, 8])
@pytest.mark.parametrize("fields", ["xyz", "xyzr", "rnzyx"])
@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_every_kind(kind: str, fields: str, real: int, newline: str) -> None:
    cloud = read_cloud(pcd(POINTS, kind, fields, real=real, newline=newline))
    assert cloud.dtype == np.float32
    np.testing.assert_array_equal(cloud, POINTS)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_missing_points_of_an_organised_pcd_are_left_out(kind: str) -> None:
    image = POINTS.copy()
    image[[3, 7, 20]] = np.nan
    cloud = read_cloud(pcd(image, kind, height=5))
    np.testing.assert_array_equal(cloud, np.delete(POINTS, [3, 7, 20], axis=0))
    # One row is a list of points: there NaN is left for the estimator to refuse.
    assert np.isnan(read_cloud(pcd(image, kind))).any(axis=1).sum() == 3


def test_arrays_flat_and_organised() -> None:
    np.testing.assert_array_equal(read_cloud(npy(POINTS.astype(">f8"))), POINTS)
    image = POINTS.reshape(5, 10, 3).copy()
    image[2, 3, 1] = np.nan
    np.testing.assert_array_equal(read_cloud(npy(image)), np.delete(POINTS, 23, axis=0))


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_an_empty_cloud_is_a_cloud(kind: str) -> None:
    none = POINTS[:0]
    for content in (npy(none), pcd(none, kind), *(ply(none, order) for order in PLY_ORDERS)):
        assert read_cloud(content).shape == (0, 3)


def test_files_are_told_apart_by_content_and_named_by_path(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_bytes(ply(POINTS, "ascii"))
    np.testing.assert_array_equal(read_cloud(path), POINTS)
    np.testing.assert_array_equal(read_cloud(str(path)), POINTS)
    path.write_bytes(b"hello")
    with pytest.raises(
        InputError, match=rf"^{path} must be a point cloud as PLY, PCD or NPY, got another kind of file"
    ):
        read_cloud(path)
    with pytest.raises(InputError, match=r"^upload must be a point cloud, got a PNG: a depth image needs its camera"):
        read_cloud(b"\x89PNG\r\n\x1a\n", "upload")
    with pytest.raises(InputError, match="but it is empty"):
        read_cloud(b"")


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
        (BINARY.replace(b"vertex 50", b"vertex 5000000"), "at most 4000000 vertices, got 5000000"),
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


PCD, PACKED = pcd(POINTS, "binary"), pcd(POINTS, "binary_compressed")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# .PCD v0.7\n", "its header must end with DATA ascii, binary or binary_compressed"),
        (PCD.replace(b"DATA binary", b"DATA zipped"), "its header must end with DATA"),
        (PCD.replace(b"FIELDS x y z\n", b""), "must name 1 to 256 FIELDS, got 0"),
        (PCD.replace(b"FIELDS x y z", b"FIELDS x y w"), "must hold x, y and z once each, got x y w"),
        (PCD.replace(b"SIZE 4 4 4", b"SIZE 4 4"), "must have 3 whole numbers as SIZE, got '4 4'"),
        (PCD.replace(b"SIZE 4 4 4", b"SIZE 4 4 2"), "its field z must be F of 4 or 8 bytes, got F of 2"),
        (PCD.replace(b"TYPE F F F", b"TYPE F F I"), "its field z must be F of 4 or 8 bytes, got I of 4"),
        (PCD.replace(b"TYPE F F F", b"TYPE F F"), "must have a TYPE for each of the 3 fields, got 2"),
        (PCD.replace(b"COUNT 1 1 1", b"COUNT 1 1 0"), "its field z must be F"),
        (PCD.replace(b"COUNT 1 1 1", b"COUNT 1 1 99999999"), "must have 1 to 65536 bytes each"),
        (PCD.replace(b"WIDTH 50", b"WIDTH 51"), "its POINTS must be WIDTH x HEIGHT = 51, got 50"),
        (PCD.replace(b"WIDTH 50\n", b""), "must have 1 whole numbers as WIDTH"),
        (PCD.replace(b" 50\n", b" 999999999\n"), "at most 4000000 points, got 999999999"),
        (PCD[:-1], "promises 50 points of 12 bytes, but only 599 bytes follow: it is truncated"),
        (PACKED[:-10], "compressed bytes, but only .* follow: it is truncated"),
        (PACKED[: PACKED.index(b"compressed\n") + 14], "ends before its compressed points"),
        (
            PACKED.replace(struct.pack("<I", 600), struct.pack("<I", 601)),
            "must unpack to 600 bytes, its header says 601",
        ),
        (PACKED.replace(struct.pack("<I", 619), struct.pack("<I", 400)), "compressed points end early"),
        (PACKED.replace(b"\x1f", b"\xff", 1), "compressed points are damaged"),
    ],
)
def test_a_damaged_pcd_is_one_sentence(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=f"^scan.pcd must be a point cloud, but .*{message}"):
        read_cloud(content, "scan.pcd")


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


LYING = [
    BINARY.replace(b"vertex 50", b"vertex 4000000"),
    ASCII.replace(b"vertex 50", b"vertex 4000000"),
    BINARY.replace(b"element vertex", b"element camera 999999999999999\nproperty double a\nelement vertex"),
    ASCII.replace(b"element vertex", b"element camera 999999999999999\nproperty double a\nelement vertex"),
    PCD.replace(b" 50\n", b" 4000000\n"),
    pcd(POINTS, "ascii").replace(b" 50\n", b" 4000000\n"),
    PACKED.replace(b" 50\n", b" 4000000\n").replace(struct.pack("<I", 600), struct.pack("<I", 48_000_000)),
    PACKED.replace(b" 50\n", b" 4000000\n")
    .replace(b"COUNT 1 1 1", b"COUNT 1 1 80")
    .replace(struct.pack("<I", 600), struct.pack("<I", 1_312_000_000)),
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


def test_packed_data_that_are_larger_than_unpacked_ones_are_refused() -> None:
    slow = struct.pack("<II", 1200, 600) + bytes(1200)
    with pytest.raises(InputError, match="its 1200 compressed bytes must not be more than the 600 they unpack to"):
        read_cloud(PACKED[: PACKED.index(b"compressed\n") + 11] + slow)


WHOLE = [
    *(ply(POINTS[:4], order, "nxryz") for order in PLY_ORDERS),
    *(pcd(POINTS[:4], kind, "xyzr", height=2) for kind in ("ascii", "binary", "binary_compressed")),
    npy(POINTS[:4]),
]


@given(st.sampled_from(WHOLE), st.data())
def test_no_damaged_file_raises_anything_else(whole: bytes, data: st.DataObject) -> None:
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(content) - 1))
        action = data.draw(st.sampled_from(["change", "remove", "insert"]))
        if action == "change":
            content[place] = data.draw(st.integers(0, 255))
        elif action == "remove":
            del content[place : place + data.draw(st.integers(1, 8))]
        else:
            content[place:place] = data.draw(
                st.binary(max_size=6) | st.sampled_from([b"9", b"\n", b"-1", b"nan ", b"\xa0"])
            )
        if not content:
            content = bytearray(b"p")
    with suppress(InputError):
        cloud = read_cloud(bytes(content))
        assert cloud.ndim == 2
        assert cloud.shape[1] == 3


@given(
    st.sampled_from([b"ply\n", b"# .PCD", b"VERSION .7\n", b"\x93NUMPY", b"\x93NUMPY\x01\x00"]), st.binary(max_size=200)
)
def test_no_bytes_raise_anything_else(magic: bytes, rest: bytes) -> None:
    with suppress(InputError):
        read_cloud(magic + rest)


@pytest.mark.parametrize("rows", [65_535, 65_536, 65_537, 140_000])
def test_long_texts_are_read_in_blocks(rows: int) -> None:
    points = np.arange(3 * rows, dtype=np.float32).reshape(-1, 3)
    stream = io.BytesIO()
    np.savetxt(stream, points, fmt="%d")
    header = ply(points[:0], "ascii").decode().replace("vertex 0", f"vertex {rows}").split("3 0 1 2")[0]
    np.testing.assert_array_equal(read_cloud(header.encode() + stream.getvalue()), points)
    with pytest.raises(InputError, match=f"promises {rows} points, but only {rows - 1} follow"):
        read_cloud(header.encode() + stream.getvalue().rstrip().rsplit(b"\n", 1)[0] + b"\n" * 10)
