"""Depth images: 16-bit PNG or .npy, and the pinhole camera that makes points of them."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pointcloud import back_project
from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.array_bytes import NPY_MAGIC, array_from_npy
from attentionvote.inference.scans.file_bytes import file_bytes

MOST_PIXELS = 8_000_000
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class CameraIntrinsics:
    """A pinhole camera without distortion and what its counts mean: z = depth_offset + depth_scale * count.

    Args:
        fx, fy, cx, cy: pixels, pixel centres at whole numbers.
        depth_scale: metres per count of an image of whole numbers.
        depth_offset: metres at count 0.
        missing: the count of a pixel without measurement.
        width, height: of its images in pixels; images of another size are refused. None: any.

    Images of floating-point numbers are metres already; there 0 and NaN are missing and scale and offset unused.

    Raises:
        InputError: on an impossible value.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: float = 0.001
    depth_offset: float = 0.0
    missing: int = 0
    width: int | None = None
    height: int | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "depth_scale", "depth_offset"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise InputError(f"camera {name} must be a finite number, got {value!r}")
        for name in ("fx", "fy", "depth_scale"):
            if not getattr(self, name) > 0:
                raise InputError(f"camera {name} must be positive, got {getattr(self, name)}")
        if self.depth_offset < 0:
            raise InputError(f"camera depth_offset must be at least 0 metres, got {self.depth_offset}")
        for name, least in (("missing", 0), ("width", 1), ("height", 1)):
            value = getattr(self, name)
            if value is None and name != "missing":
                continue
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**32:
                raise InputError(f"camera {name} must be a whole number of at least {least}, got {value!r}")

    def points(self, depth: NDArray[Any]) -> NDArray[np.float32]:
        """Measured points ``(P, 3)`` metres, camera frame, of a depth image ``(H, W)``.

        Raises:
            InputError: when the image does not fit the camera or has negative depth.
        """
        if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "uif":
            got = f"{depth.dtype} of shape {depth.shape}" if isinstance(depth, np.ndarray) else type(depth).__name__
            raise InputError(f"depth must be an image (H, W) of numbers, got {got}")
        if depth.size > MOST_PIXELS:
            raise InputError(f"depth must have at most {MOST_PIXELS} pixels, got {depth.size}")
        for name, expected, actual in (("width", self.width, depth.shape[1]), ("height", self.height, depth.shape[0])):
            if expected is not None and expected != actual:
                raise InputError(f"depth must have the camera's {name} of {expected} pixels, got {actual}")
        if depth.dtype.kind == "f":
            metres = depth
        else:
            metres = self.depth_offset + self.depth_scale * depth.astype(np.float64)
            metres[depth == self.missing] = np.nan
        try:
            return back_project(metres, self.fx, self.fy, self.cx, self.cy)[0]
        except ValueError as error:
            raise InputError(str(error)) from error


def read_depth(source: Path | str | bytes, name: str = "") -> NDArray[Any]:
    """A depth image ``(H, W)``: uint16 counts of a PNG, or what a .npy file holds.

    Args:
        source: path, or the file's content.
        name: for messages when the content is given.

    Raises:
        InputError: with one sentence, when it is no depth image, damaged or too large.
    """
    content, name = file_bytes(source, name)
    if content.startswith(PNG_MAGIC):
        return _png(content, name)
    if content.startswith(NPY_MAGIC):
        try:
            image = array_from_npy(content, 8 * MOST_PIXELS)
        except ValueError as error:
            raise InputError(f"{name} must be a depth image (H, W), but {error}") from error
        if image.ndim != 2:
            raise InputError(f"{name} must be a depth image (H, W), got shape {image.shape}")
        return image
    raise InputError(f"{name} must be a 16-bit PNG or a .npy file with a depth image, got another kind of file")


def _png(content: bytes, name: str) -> NDArray[np.uint16]:
    # The header is read first: nothing is decoded before its size and kind are known to be right.
    if len(content) < 33 or content[12:16] != b"IHDR":
        raise InputError(f"{name} must be a PNG file, but its header is damaged")
    width, height, bits, color = struct.unpack(">IIBB", content[16:26])
    if (bits, color) != (16, 0):
        kinds = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
        raise InputError(
            f"{name} must be a 16-bit grey PNG, got {bits}-bit {kinds.get(color, 'unknown')}: "
            "send the depth, not a picture of it"
        )
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise InputError(f"{name} must have 1 to {MOST_PIXELS} pixels, got {width} x {height}")
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            image.load()
            pixels = np.asarray(image)
    except Exception as error:  # Pillow's decoders let many kinds of exceptions through
        raise InputError(
            f"{name} must be a whole PNG file, but it cannot be decoded: it is truncated or damaged"
        ) from error
    if pixels.shape != (height, width):
        raise InputError(f"{name} must be a depth image of {width} x {height}, but it decodes to shape {pixels.shape}")
    return pixels.astype(np.uint16)
