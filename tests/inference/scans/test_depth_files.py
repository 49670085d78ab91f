"""Depth images: read whole or refused in one sentence, and back-projected by the camera's own figures."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.depth_files import CameraIntrinsics, read_depth
from attentionvote.inference.scans.limits import Budget

MIB = 1024 * 1024


def png(image: NDArray) -> bytes:
    """A PNG by Pillow."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG")
    return stream.getvalue()


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def made(width: int, height: int, bits: int, color: int, data: bytes = b"") -> bytes:
    """A PNG whose header says anything."""
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


IMAGE = np.random.default_rng(0).integers(0, 65536, (12, 17), dtype=np.uint16)


def test_a_png_is_read_exactly(tmp_path: Path) -> None:
    (tmp_path / "depth.png").write_bytes(png(IMAGE))
    for source in (tmp_path / "depth.png", str(tmp_path / "depth.png"), png(IMAGE)):
        depth = read_depth(source)
        assert depth.dtype == np.uint16
        np.testing.assert_array_equal(depth, IMAGE)


def test_the_bytes_of_a_png_made_by_hand_are_big_endian() -> None:
    rows = b"".join(b"\x00" + row.astype(">u2").tobytes() for row in IMAGE)
    np.testing.assert_array_equal(read_depth(made(17, 12, 16, 0, rows)), IMAGE)


@pytest.mark.parametrize("dtype", ["<u2", "<f4", "<f8", "<i4"])
def test_an_array_is_read(dtype: str) -> None:
    stream = io.BytesIO()
    np.save(stream, IMAGE.astype(dtype))
    np.testing.assert_array_equal(read_depth(stream.getvalue()), IMAGE.astype(dtype), strict=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "must hold a cloud or a depth image, but it is empty"),
        (b"hello", "must be a 16-bit PNG or a .npy file with a depth image, got another kind"),
        (b"\x89PNG\r\n\x1a\n", "must be a PNG file, but its header is damaged"),
        (png(np.zeros((3, 3), np.uint8)), "must be a 16-bit grey PNG, got 8-bit grey: send the depth, not a picture"),
        (png(np.zeros((3, 3, 3), np.uint8)), "must be a 16-bit grey PNG, got 8-bit RGB"),
        (made(3, 3, 16, 2), "must be a 16-bit grey PNG, got 16-bit RGB"),
        (made(3, 3, 16, 9), "must be a 16-bit grey PNG, got 16-bit unknown"),
        (made(0, 3, 16, 0), "must have 1 to 8000000 pixels, got 0 x 3"),
        (made(100_000, 100_000, 16, 0), "must have 1 to 8000000 pixels, got 100000 x 100000"),
        (made(3, 3, 16, 0), "must be a whole PNG file, but it cannot be decoded: it is truncated or damaged"),
        (png(IMAGE)[:-40], "must be a whole PNG file, but it cannot be decoded: it is truncated or damaged"),
        (b"\x93NUMPY\x01\x00", "must be a depth image .* but it has no .npy header"),
    ],
)
def test_a_file_that_is_no_depth_image_is_one_sentence(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=f"^shot.png {message}"):
        read_depth(content, "shot.png")


def test_arrays_of_another_shape_are_refused() -> None:
    stream = io.BytesIO()
    np.save(stream, np.zeros((3, 3, 3)))
    with pytest.raises(InputError, match=r"must be a depth image \(H, W\), got shape \(3, 3, 3\)"):
        read_depth(stream.getvalue())


def test_an_array_of_too_many_pixels_or_of_records_is_refused() -> None:
    stream = io.BytesIO()
    np.save(stream, np.zeros((4000, 2001), np.uint8))
    with pytest.raises(InputError, match="must have 1 to 8000000 pixels, got 2001 x 4000"):
        read_depth(stream.getvalue())
    stream = io.BytesIO()
    np.save(stream, np.zeros((4, 5), [("z", "f4")]))
    with pytest.raises(InputError, match=r"must be a depth image \(H, W\), got shape \(4, 5\) of \[\('z', '<f4'\)\]"):
        read_depth(stream.getvalue())


@pytest.mark.parametrize("kind", [bytearray, memoryview])
def test_content_is_not_kept(kind: type) -> None:
    stream = io.BytesIO()
    np.save(stream, IMAGE)
    for whole in (png(IMAGE), stream.getvalue()):
        content = kind(whole)
        np.testing.assert_array_equal(read_depth(content), IMAGE)
        if isinstance(content, bytearray):
            content.clear()  # fails while an array refers to it


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a file, but there is none: check the path"):
        read_depth(tmp_path / "none.png")
    with pytest.raises(InputError, match="must be a file, got a folder"):
        read_depth(tmp_path)
    with pytest.raises(InputError, match="cannot be read: embedded null byte"):
        read_depth("a\0b")


def test_a_small_file_of_a_large_image_reserves_only_the_image() -> None:
    bomb = made(2800, 2800, 16, 0, bytes(10))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="cannot be decoded"):
            read_depth(bomb)
        assert tracemalloc.get_traced_memory()[1] < 4 * MIB
    finally:
        tracemalloc.stop()


def header(width: int, height: int, bits: int = 16, color: int = 0) -> bytes:
    """The chunk IHDR."""
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0))


@pytest.mark.parametrize("second", [header(9000, 9000), header(3000, 3000, 8, 6), header(17, 12)])
def test_a_second_header_is_refused_before_anything_is_decoded(second: bytes) -> None:
    whole = png(IMAGE)
    tracemalloc.start()
    try:
        for at in (33, len(whole) - 12):
            with pytest.raises(InputError, match=r"^the file must have one PNG header, got two: it is damaged$"):
                read_depth(whole[:at] + second + whole[at:])
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_chunks_that_are_no_pixels_are_not_looked_at() -> None:
    whole, bomb = png(IMAGE), zlib.compress(bytes(60 * MIB))
    others = (
        chunk(b"zTXt", b"a\0\0" + bomb)
        + chunk(b"iCCP", b"a\0\0" + bomb)
        + chunk(b"acTL", bytes(8))
        + chunk(b"eXIf", bomb)
    )
    read_depth(whole)  # imports
    tracemalloc.start()
    try:
        np.testing.assert_array_equal(read_depth(whole[:33] + others + whole[33:]), IMAGE)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_more_chunks_than_any_writer_makes_are_refused() -> None:
    whole = png(IMAGE)
    with pytest.raises(InputError, match="must have at most 65536 chunks, got more: write it again"):
        read_depth(whole[:33] + chunk(b"IDAT", b"") * 65_536 + whole[33:], budget=Budget(most_seconds=30.0))
    with pytest.raises(InputError, match="cannot be decoded: it is truncated or damaged"):
        read_depth(whole[:33] + struct.pack(">I", 2**32 - 1) + b"tEXt" + whole[33:])


@given(st.data())
def test_no_damaged_png_raises_anything_else(data: st.DataObject) -> None:
    content = bytearray(png(IMAGE))
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    with suppress(InputError):
        read_depth(bytes(content[: data.draw(st.integers(9, len(content)))]))


@pytest.mark.parametrize(
    "kind", [b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"tRNS", b"gAMA", b"pHYs", b"acTL", b"fcTL", b"eXIf"]
)
@pytest.mark.parametrize("content", [b"", b"\x00", b"a\x00\x00" + zlib.compress(bytes(3 * 10**6)), b"\xff" * 40])
def test_other_chunks_end_in_the_image_or_in_one_sentence(kind: bytes, content: bytes) -> None:
    whole = png(IMAGE)
    with suppress(InputError):
        np.testing.assert_array_equal(read_depth(whole[:33] + chunk(kind, content) + whole[33:]), IMAGE)


CAMERA = CameraIntrinsics(fx=500, fy=400, cx=8, cy=6)


def test_counts_become_metres_by_scale_and_offset() -> None:
    depth = np.zeros((12, 17), np.uint16)
    depth[6, 8], depth[0, 0] = 1000, 2000
    np.testing.assert_allclose(CAMERA.points(depth), [[-0.032, -0.03, 2], [0, 0, 1]], atol=1e-6)
    scaled = CameraIntrinsics(500, 400, 8, 6, depth_scale=1e-4, depth_offset=0.5, missing=65535)
    depth[:] = 65535
    depth[6, 8], depth[6, 9] = 0, 1000  # count 0 is a measurement here
    np.testing.assert_allclose(scaled.points(depth), [[0, 0, 0.5], [0.6 / 500, 0, 0.6]], atol=1e-6)


@pytest.mark.parametrize(("dtype", "largest"), [(np.uint16, 65535), (np.uint8, 255), (np.int16, 32767)])
def test_pixels_at_the_largest_count_are_missing_and_the_camera_must_say_so(dtype: type, largest: int) -> None:
    depth = np.full((12, 17), 100, dtype)
    depth[:, :4] = largest
    message = (
        f"depth must have counts of measurements only, beside the camera's missing 0, but 24% of the pixels have the "
        f'largest count: are these the missing ones\\? write "missing": {largest} into the cell file'
    )
    with pytest.raises(InputError, match=message):
        CAMERA.points(depth)
    named = CameraIntrinsics(fx=500, fy=400, cx=8, cy=6, missing=largest)
    assert len(named.points(depth)) == 12 * 13
    depth[:, :4] = 100
    depth[0, :4] = largest  # a few may be saturated
    assert len(CAMERA.points(depth)) == 12 * 17


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_floating_point_images_are_metres_already(dtype: type) -> None:
    depth = np.full((12, 17), np.nan, dtype)
    depth[6, 8], depth[6, 9] = 0.5, 0.0
    scaled = CameraIntrinsics(500, 400, 8, 6, depth_scale=1e-4, depth_offset=0.5)
    np.testing.assert_allclose(scaled.points(depth), [[0, 0, 0.5]], atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_points_project_to_their_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.integers(1, 5000, (12, 17)).astype(np.uint16)
    points = CAMERA.points(depth).astype(np.float64)
    u, v = 500 * points[:, 0] / points[:, 2] + 8, 400 * points[:, 1] / points[:, 2] + 6
    rows, columns = np.indices((12, 17)).reshape(2, -1)
    np.testing.assert_allclose(u, columns, atol=1e-3)
    np.testing.assert_allclose(v, rows, atol=1e-3)
    np.testing.assert_allclose(points[:, 2], depth.ravel() / 1000, rtol=1e-6)


def test_an_image_of_another_size_than_the_cameras_is_refused() -> None:
    camera = CameraIntrinsics(500, 400, 8, 6, width=17, height=12)
    camera.points(IMAGE)
    with pytest.raises(InputError, match="must have the camera's width of 17 pixels, got 12"):
        camera.points(IMAGE.T)
    with pytest.raises(InputError, match="must have the camera's height of 12 pixels, got 11"):
        camera.points(IMAGE[1:])


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        ([[1]], r"depth must be an image \(H, W\) of numbers, got list"),
        (np.zeros(3), r"got float64 of shape \(3,\)"),
        (np.zeros((3, 3), bool), r"got bool of shape \(3, 3\)"),
        (np.full((2, 2), -1.0), "depth must not be negative"),
        (np.full((2, 2), -1000, np.int32), "depth must not be negative"),
        (np.broadcast_to(np.uint16(1), (5000, 5000)), "must have at most 8000000 pixels, got 25000000"),
    ],
)
def test_an_array_that_is_no_depth_image_is_one_sentence(depth: NDArray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CAMERA.points(depth)
