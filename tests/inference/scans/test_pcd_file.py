"""PCD in every kind and layout exactly, every damage in one sentence, no memory for a lying header."""

from __future__ import annotations

import re
import struct
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, matrix_from_quaternion, transform
from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.cloud_files import read_cloud

MIB = 1024 * 1024
POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
KINDS = ("ascii", "binary", "binary_compressed")
pytestmark = pytest.mark.usefixtures("way")


def lzf_literals(data: bytes) -> bytes:
    """Data packed without any repetition: what a compressor writes when it finds none."""
    return b"".join(bytes([len(part) - 1]) + part for part in (data[i : i + 32] for i in range(0, len(data), 32)))


def pcd(
    points: NDArray,
    kind: str,
    fields: str = "xyz",
    height: int = 1,
    real: int = 4,
    newline: str = "\n",
    viewpoint: str = "0 0 0 1 0 0 0",
) -> bytes:
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
        f"VIEWPOINT {viewpoint}",
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


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("real", [4, 8])
@pytest.mark.parametrize("fields", ["xyz", "xyzr", "rnzyx"])
@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_every_kind(kind: str, fields: str, real: int, newline: str) -> None:
    cloud = read_cloud(pcd(POINTS, kind, fields, real=real, newline=newline))
    assert cloud.dtype == np.float32
    np.testing.assert_array_equal(cloud, POINTS)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("height", [1, 5])
def test_missing_points_keep_their_places(kind: str, height: int) -> None:
    image = POINTS.copy()
    image[3], image[7], image[20] = (np.nan, np.nan, 1), (0.1, np.inf, 0.5), (0, -0.0, 0)
    expected = POINTS.copy()
    expected[[3, 7, 20]] = np.nan
    cloud = read_cloud(pcd(image, kind, height=height))
    np.testing.assert_array_equal(cloud, expected.reshape(5, 10, 3) if height == 5 else expected)


def test_names_of_axes_may_be_capitals() -> None:
    np.testing.assert_array_equal(read_cloud(PCD.replace(b"FIELDS x y z", b"FIELDS X Y Z")), POINTS)


TURNED = "0.1 -0.2 1.5 0.5 0.5 -0.5 0.5"


@pytest.mark.parametrize("kind", KINDS)
def test_points_come_into_the_frame_of_the_viewpoint(kind: str) -> None:
    cloud_from_camera = transform(matrix_from_quaternion([0.5, 0.5, -0.5, 0.5]), [0.1, -0.2, 1.5])
    in_cloud = apply(cloud_from_camera, POINTS).astype(np.float32)
    in_cloud[4], expected = np.nan, POINTS.copy()
    expected[4] = np.nan
    np.testing.assert_allclose(read_cloud(pcd(in_cloud, kind, viewpoint=TURNED)), expected, atol=1e-6)


@pytest.mark.parametrize("viewpoint", ["0 0 0 1 0 0 0", "0 0 0 -1 0 0 0", "0.0 -0.0 0 0.9999999 0 0 0"])
def test_a_viewpoint_at_the_camera_changes_not_a_bit(viewpoint: str) -> None:
    assert read_cloud(pcd(POINTS, "binary", viewpoint=viewpoint)).tobytes() == POINTS.tobytes()
    assert read_cloud(PCD.replace(b"VIEWPOINT 0 0 0 1 0 0 0\n", b"")).tobytes() == POINTS.tobytes()


@pytest.mark.parametrize(
    "viewpoint",
    ["0 0 0 0 0 0 0", "0 0 0 1 0 0", "0 0 0 1 0 0 0 0", "nan 0 0 1 0 0 0", "0 0 0 1e300 0 0 0", "a b c d e f g"],
)
def test_an_impossible_viewpoint_is_refused(viewpoint: str) -> None:
    message = (
        f"its VIEWPOINT must be a pose tx ty tz qw qx qy qz with a quaternion of length 1, got '{viewpoint}': write 0"
    )
    with pytest.raises(InputError, match=re.escape(message)):
        read_cloud(pcd(POINTS, "binary", viewpoint=viewpoint))


@pytest.mark.parametrize("kind", KINDS)
def test_more_points_than_promised_are_refused_and_padding_is_not(kind: str) -> None:
    whole = pcd(POINTS, kind)
    np.testing.assert_array_equal(read_cloud(whole + b"\n \r\n" + bytes(4096)), POINTS)
    with pytest.raises(InputError, match="promises 50 points, but more follows them: mend POINTS and WIDTH"):
        read_cloud(whole + b"\n0.5 0.5 0.5\n")


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_cloud_is_a_cloud(kind: str) -> None:
    assert read_cloud(pcd(POINTS[:0], kind)).shape == (0, 3)
    with pytest.raises(InputError, match="promises 0 points, but more follows them"):
        read_cloud(pcd(POINTS[:0], kind) + b"1 2 3\n")


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
        (PCD.replace(b" 50\n", b" 999999999\n"), "promises 999999999 points of 12 bytes, but only 600 bytes follow"),
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


LYING = [
    PCD.replace(b" 50\n", b" 4000000\n"),
    pcd(POINTS, "ascii").replace(b" 50\n", b" 4000000\n"),
    PACKED.replace(b" 50\n", b" 4000000\n").replace(struct.pack("<I", 600), struct.pack("<I", 48_000_000)),
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


def test_coordinates_far_behind_in_packed_data_are_refused_before_anything_is_unpacked() -> None:
    far = (
        PACKED.replace(b" 50\n", b" 4000000\n")
        .replace(b"COUNT 1 1 1", b"COUNT 1 1 80")
        .replace(struct.pack("<I", 600), struct.pack("<I", 1_312_000_000))
    )
    with pytest.raises(InputError, match="its coordinates must lie within 268435456 unpacked bytes, got 1312000000"):
        read_cloud(far)


def test_packed_data_that_are_larger_than_unpacked_ones_are_refused() -> None:
    slow = struct.pack("<II", 1200, 600) + bytes(1200)
    with pytest.raises(InputError, match="its 1200 compressed bytes must not be more than the 600 they unpack to"):
        read_cloud(PACKED[: PACKED.index(b"compressed\n") + 11] + slow)


Damage = Callable[[bytes, st.DataObject], bytes]
WHOLE = [pcd(POINTS[:4], kind, "xyzr", height=2) for kind in KINDS]


@given(st.sampled_from(WHOLE), st.data())
def test_no_damaged_file_raises_anything_else(damaged: Damage, whole: bytes, data: st.DataObject) -> None:
    with suppress(InputError):
        assert read_cloud(damaged(whole, data)).shape[-1] == 3
