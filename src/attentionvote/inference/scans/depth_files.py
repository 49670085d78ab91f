"""Depth images: 16-bit PNG or .npy, and the pinhole camera that makes points of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pointcloud import back_project
from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.array_bytes import array_from_npy
from attentionvote.inference.scans.camera_figures import check_depth_coding, check_focal_lengths, check_principal_point
from attentionvote.inference.scans.file_bytes import Content, content_view
from attentionvote.inference.scans.limits import MOST_PIXELS, Budget
from attentionvote.inference.scans.npy_header import NPY_MAGIC
from attentionvote.inference.scans.other_kinds import other_kind
from attentionvote.inference.scans.png_depth import PNG_MAGIC, depth_from_png
from attentionvote.inference.scans.sentences import single_line

# Of an image's pixels: fewer at the largest count may be saturated ones.
_MISSING_SHARE = 0.02


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
        for name, least in (("missing", 0), ("width", 1), ("height", 1)):
            value = getattr(self, name)
            if value is None and name != "missing":
                continue
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value < 2**32:
                raise InputError(f"camera {name} must be a whole number of at least {least}, got {value!r}")
        check_focal_lengths(self.fx, self.fy, self.width, self.height)
        check_principal_point(self.cx, self.cy, self.width, self.height)
        check_depth_coding(self.depth_scale, self.depth_offset)

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
            self._check_missing(depth)
            metres = self.depth_offset + self.depth_scale * depth.astype(np.float64)
            metres[depth == self.missing] = np.nan
        try:
            return back_project(metres, self.fx, self.fy, self.cx, self.cy)[0]
        except ValueError as error:
            raise InputError(str(error)) from error

    def _check_missing(self, depth: NDArray[np.integer]) -> None:
        """Refuse an image whose missing pixels have another count than the camera says."""
        largest = int(np.iinfo(depth.dtype).max)
        share = np.count_nonzero(depth == largest) / max(depth.size, 1)
        if self.missing != largest and share > _MISSING_SHARE:
            raise InputError(
                f"depth must have counts of measurements only, beside the camera's missing {self.missing}, "
                f"but {share:.0%} of the pixels have the largest count: are these the missing ones? "
                f'write "missing": {largest} into the cell file'
            )


def read_depth(source: Path | str | Content, name: str = "", *, budget: Budget | None = None) -> NDArray[Any]:
    """A depth image ``(H, W)``: uint16 counts of a PNG, or what a .npy file holds. The array is new.

    Args:
        source: path, or the file's content, which is not copied.
        name: for messages when the content is given.
        budget: what reading may cost; None: the usual one.

    Raises:
        InputError: with one sentence, when it is no depth image, damaged, too large or too slow to read.
    """
    content, name = content_view(source, name)
    budget = budget or Budget()
    try:
        if bytes(content[:8]) == PNG_MAGIC:
            return depth_from_png(content, name, budget)
        if content[:6] == NPY_MAGIC:
            return _from_npy(content, name, budget)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(single_line(f"{name} must be a depth image (H, W), but {error}")) from error
    kind = other_kind(content, name) or "another kind of file"
    raise InputError(f"{name} must be a 16-bit PNG or a .npy file with a depth image, got {kind}")


def _from_npy(content: memoryview, name: str, budget: Budget) -> NDArray[Any]:
    image = array_from_npy(content)
    if image.ndim != 2 or image.dtype.names is not None:
        fields = f" of {image.dtype}" if image.dtype.names is not None else ""
        raise InputError(single_line(f"{name} must be a depth image (H, W), got shape {image.shape}{fields}"))
    if image.size > MOST_PIXELS:
        raise InputError(f"{name} must have 1 to {MOST_PIXELS} pixels, got {image.shape[1]} x {image.shape[0]}")
    budget.take(image.nbytes)
    return image.copy()
