"""Images of depth and of labels, to and from files; what counts mean in metres; the camera that makes points of them.

The only place of the readers that opens an image. Depth is read at 16 bits or refused: a reader that lets a library
convert it to 8 bits gets a relief of 256 steps and no error.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.files import whole
from attentionvote.geometry.pointcloud import back_project

MOST_PIXELS = 50_000_000
TOP = 65535


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels, pixel centres at whole numbers, OpenCV convention.

    Raises:
        ValueError: when the size or a focal length is not positive.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not 0 < getattr(self, name) < 1e9:
                raise ValueError(f"camera {name} must be positive, got {getattr(self, name)}")
        if not np.isfinite([self.cx, self.cy]).all():
            raise ValueError(f"camera cx and cy must be finite, got {self.cx} and {self.cy}")

    def points(self, depth: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Points ``(P, 3)`` in metres of a depth image ``(H, W)`` and the flat pixel ``(P,)`` of each; NaN is missing.

        Raises:
            ValueError: when the image has another size, or negative depth.
        """
        self.check_size(depth, "the depth image")
        return back_project(depth, self.fx, self.fy, self.cx, self.cy)

    def check_size(self, image: NDArray[Any], what: str) -> None:
        """ValueError when an image ``(H, W)`` does not have the camera's size."""
        if image.shape != (self.height, self.width):
            got = " x ".join(map(str, image.shape[::-1]))
            raise ValueError(f"{what} must have the camera's {self.width} x {self.height} pixels, got {got}")


@dataclass(frozen=True)
class DepthCoding:
    """What the counts of a 16-bit depth image mean: z = offset + scale * count.

    Args:
        offset: metres at count 0.
        scale: metres per count.
        missing: counts without measurement; the last one is written for it.

    Raises:
        ValueError: when no such camera exists.
    """

    offset: float
    scale: float
    missing: tuple[int, ...]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.offset) and self.offset >= 0):
            raise ValueError(f"the depth at count 0 must be at least 0 metres, got {self.offset}")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"the depth per count must be positive metres, got {self.scale}")

    @classmethod
    def between(cls, clip_start: float, clip_end: float, missing: tuple[int, ...]) -> DepthCoding:
        """z = clip_start + (clip_end - clip_start) * count / 65535, as IPA and Sileane have it.

        Raises:
            ValueError: when the range is empty.
        """
        if not clip_end > clip_start:
            raise ValueError(f"clip_end must be greater than clip_start, got {clip_end} and {clip_start} m")
        return cls(clip_start, (clip_end - clip_start) / TOP, missing)

    def decode(self, counts: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Metres of counts of any shape, NaN where there is no measurement."""
        depth = self.offset + self.scale * counts.astype(np.float64)
        depth[np.isin(counts, self.missing)] = np.nan
        return depth

    def encode(self, depth: NDArray[np.floating]) -> NDArray[np.uint16]:
        """Counts of metres of any shape; what is not finite is missing.

        Raises:
            ValueError: when a depth cannot be told in these counts.
        """
        measured = np.isfinite(depth)
        counts = np.rint((np.where(measured, depth, self.offset) - self.offset) / self.scale)
        usable = next(c for c in range(3) if c not in self.missing), TOP - (TOP in self.missing)
        bad = measured & ((counts < usable[0]) | (counts > usable[1]))
        if bad.any():
            low, high = (self.offset + self.scale * c for c in usable)
            raise ValueError(
                f"depth must lie in {low:.4g}..{high:.4g} m to be written, got {np.min(depth[bad]):.4g} m: "
                "widen the range of the file"
            )
        return np.where(measured, counts, self.missing[-1]).astype(np.uint16)


def read_depth_counts(path: Path) -> NDArray[np.uint16]:
    """Counts ``(H, W)`` of a 16-bit grey image.

    Raises:
        ValueError: with one sentence, when the file is missing, damaged or not 16-bit grey.
    """
    pixels, mode = _read(path)
    if not mode.startswith("I") or pixels.ndim != 2 or pixels.min(initial=0) < 0 or pixels.max(initial=0) > TOP:
        raise ValueError(f"{path}: a depth image must be 16-bit grey, got mode {mode}: is it a picture of the depth?")
    return pixels.astype(np.uint16)


def read_labels(path: Path) -> NDArray[np.int64]:
    """Values ``(H, W)`` of an 8- or 16-bit image of labels; of a palette image its indices.

    Raises:
        ValueError: with one sentence, when the file is missing, damaged or has several channels.
    """
    pixels, mode = _read(path)
    if pixels.ndim != 2 or mode == "F":
        raise ValueError(f"{path}: an image of labels must have one channel of whole numbers, got mode {mode}")
    return pixels.astype(np.int64)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, without decoding it.

    Raises:
        ValueError: with one sentence, when the file is missing or no image.
    """
    with _opened(path) as image:
        return image.size


def write_image(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write ``(H, W)`` as a grey PNG of its own depth (8 or 16 bits), whole or not at all."""
    from PIL import Image

    whole(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3))


def _read(path: Path) -> tuple[NDArray[Any], str]:
    with _opened(path) as image:
        if image.width * image.height > MOST_PIXELS:
            raise ValueError(f"at most {MOST_PIXELS} pixels are read, it has {image.width} x {image.height}")
        image.load()
        return np.asarray(image), image.mode


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    from PIL import Image

    if not path.is_file():
        raise ValueError(f"{path}: the image does not exist")
    try:
        with Image.open(path, formats=["PNG", "TIFF"]) as image:
            yield image
    except Exception as error:  # Pillow's decoders let many kinds of exceptions through
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: the image cannot be decoded, is it whole? ({reason})") from error
