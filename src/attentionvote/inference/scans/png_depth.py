"""Depth images from 16-bit grey PNG files: only pixels are decoded, and that once size and kind are right."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.limits import MOST_CHUNKS, MOST_PIXELS, Budget

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_HEAD = struct.Struct(">I4s")
_KINDS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_HEADER_BYTES, _BITS, _GREY = 25, 16, 0  # of the chunk IHDR, with its length, name and checksum
_CHUNKS_A_LOOK = 1024  # between two looks at the clock
_MODES = ("I;16", "I;16B", "I")  # of a 16-bit grey image, by version of Pillow


def depth_from_png(content: memoryview, name: str, budget: Budget) -> NDArray[np.uint16]:
    """The counts ``(H, W)`` of a PNG file.

    Args:
        content: the file.
        name: for messages.
        budget: the image's bytes are taken from it.

    Raises:
        InputError: when it is no whole 16-bit grey PNG file, or too large.
        ValueError: when the budget is spent.
    """
    if len(content) < 8 + _HEADER_BYTES or bytes(content[8:16]) != b"\0\0\0\x0dIHDR":
        raise InputError(f"{name} must be a PNG file, but its header is damaged")
    width, height, bits, color = struct.unpack_from(">IIBB", content, 16)
    if (bits, color) != (_BITS, _GREY):
        raise InputError(
            f"{name} must be a 16-bit grey PNG, got {bits}-bit {_KINDS.get(color, 'unknown')}: "
            "send the depth, not a picture of it"
        )
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise InputError(f"{name} must have 1 to {MOST_PIXELS} pixels, got {width} x {height}")
    parts = list(_pixel_chunks(content, name, budget))
    budget.take(sum(map(len, parts)) + 2 * width * height)
    return _decoded(b"".join([PNG_MAGIC, *parts]), (width, height), name, budget)


def _pixel_chunks(content: memoryview, name: str, budget: Budget) -> Iterator[memoryview]:
    """IHDR, IDAT and IEND; texts, colour profiles and animations would only cost memory."""
    at, count, ended = 8, 0, False
    while not ended and at + 12 <= len(content):
        length, kind = _HEAD.unpack_from(content, at)
        end = at + 12 + length
        count += 1
        if count > MOST_CHUNKS:
            raise InputError(f"{name} must have at most {MOST_CHUNKS} chunks, got more: write it again")
        if count % _CHUNKS_A_LOOK == 0:
            budget.check_time()
        if kind == b"IHDR" and count > 1:
            raise InputError(f"{name} must have one PNG header, got two: it is damaged")
        if end > len(content):
            break
        if kind in (b"IHDR", b"IDAT", b"IEND"):
            yield content[at:end]
        ended, at = kind == b"IEND", end
    if not ended:
        raise InputError(_broken(name))


def _decoded(png: bytes, size: tuple[int, int], name: str, budget: Budget) -> NDArray[np.uint16]:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(png), formats=["PNG"]) as image:
            # Compared again: the header that Pillow took must be the one that was checked.
            right = image.size == size and image.mode in _MODES
            if right:
                image.load()
                pixels = np.asarray(image)
    except Exception as error:  # Pillow's decoders let many kinds of exceptions through
        raise InputError(_broken(name)) from error
    budget.check_time()
    if not right or pixels.shape != size[::-1]:
        raise InputError(f"{name} must be a depth image of {size[0]} x {size[1]}, but it decodes to another one")
    return pixels.astype(np.uint16)


def _broken(name: str) -> str:
    return f"{name} must be a whole PNG file, but it cannot be decoded: it is truncated or damaged"
