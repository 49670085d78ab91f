"""Arrays from the bytes of .npy and .npz files: no pickles, no header is evaluated as Python, no size is believed."""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

NPY_MAGIC = b"\x93NUMPY"
NPZ_MAGIC = b"PK\x03\x04"
_MOST_HEADER_BYTES, _MOST_MEMBERS = 4096, 32
# What numpy and the libraries in other languages write; numpy itself evaluates this text as Python.
_HEADER = re.compile(
    r"""\{\s*['"]descr['"]:\s*['"](?P<type>[<>|=]?[fiu]\d{1,2})['"],\s*
    ['"]fortran_order['"]:\s*(?P<fortran>True|False),\s*
    ['"]shape['"]:\s*\((?P<shape>[\d,\s]{0,200})\),?\s*\}\s*""",
    re.VERBOSE,
)


def array_from_npy(content: bytes, most_bytes: int) -> NDArray[Any]:
    """The array of a .npy file, as a read-only view of ``content``.

    Args:
        content: the file.
        most_bytes: of the array's data.

    Raises:
        ValueError: with what is wrong, when it is no .npy file of numbers, or its data do not fill its shape exactly.
    """
    text, start = _header(content)
    said = _HEADER.fullmatch(text)
    if said is None:
        raise ValueError("its .npy header does not describe an array of plain numbers")
    try:
        dtype = np.dtype(said["type"])
    except TypeError as error:
        raise ValueError(f"its values must be numbers of a usual size, got {said['type']}") from error
    words = [word.strip() for word in said["shape"].split(",")]
    if not all(word.isdecimal() and len(word) < 16 for word in words[:-1]) or not (words[-1] + "0").isdecimal():
        raise ValueError(f"its shape ({said['shape'][:40]}) is impossible")
    shape = tuple(int(word) for word in words if word)
    size, there = math.prod(shape) * dtype.itemsize, len(content) - start
    if size > most_bytes or len(shape) > 8:
        raise ValueError(f"its data must have at most {most_bytes} bytes, got shape {shape} of {dtype}")
    if size != there:
        damage = "it is truncated" if size > there else "something follows them"
        raise ValueError(f"its shape {shape} of {dtype} needs {size} bytes, got {there}: {damage}")
    return np.ndarray(shape, dtype, content, start, order="F" if said["fortran"] == "True" else "C")


def _header(content: bytes) -> tuple[str, int]:
    """The header's text and where the data begin."""
    if not content.startswith(NPY_MAGIC) or len(content) < 12:
        raise ValueError("it has no .npy header")
    layout, first = ("<H", 10) if content[6] == 1 else ("<I", 12)
    (length,) = struct.unpack_from(layout, content, 8)
    if content[6] not in (1, 2, 3) or length > _MOST_HEADER_BYTES or first + length > len(content):
        raise ValueError("its .npy header is damaged")
    return content[first : first + length].decode("latin-1"), first + length


def arrays_from_npz(content: bytes, most_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name.

    Args:
        content: the file.
        most_bytes: of all arrays together, unpacked.

    Raises:
        ValueError: with what is wrong, when it is no .npz file of numbers, or larger than that.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if len(members) > _MOST_MEMBERS:
                raise ValueError(f"it must have at most {_MOST_MEMBERS} arrays, got {len(members)}")
            left = most_bytes
            for member in members:
                with archive.open(member) as file:
                    data = file.read(left + 1)  # the size in the archive's directory may lie
                if len(data) > left:
                    raise ValueError(f"its arrays must have at most {most_bytes} bytes")
                left -= len(data)
                arrays[member.filename.removesuffix(".npy")] = array_from_npy(data, most_bytes)
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError) as error:
        raise ValueError("it is no .npz archive, or damaged") from error  # RuntimeError: encrypted, or unknown packing
    return arrays
