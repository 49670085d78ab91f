"""Arrays from the bytes of .npy and .npz files, without pickles and without believing a header's sizes."""

from __future__ import annotations

import io
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_KINDS = "fiu"
_MOST_MEMBERS = 32


def array_from_npy(content: bytes, most_bytes: int) -> NDArray[Any]:
    """The array of a .npy file; a read-only view of ``content`` where possible.

    Args:
        content: the file.
        most_bytes: of the array's data.

    Raises:
        ValueError: when it is no .npy file of numbers, its data do not fill its shape exactly, or there are too many.
    """
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except Exception as error:  # numpy evaluates the header's text, so anything can come out of it
        raise ValueError("it has no .npy header") from error
    if dtype.kind not in _KINDS or dtype.hasobject:
        raise ValueError(f"its values must be numbers, got {str(dtype)[:60]}")
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError("its shape is impossible")
    count = 1
    for n in shape:
        count *= n  # Python's integers do not overflow
    size, there = count * dtype.itemsize, len(content) - stream.tell()
    if size > most_bytes:
        raise ValueError(f"its data must have at most {most_bytes} bytes, got {size}")
    if size != there:
        raise ValueError(f"its shape {shape} of {dtype} needs {size} bytes, got {there}")
    flat = np.frombuffer(content, dtype=dtype, count=count, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C")


def arrays_from_npz(content: bytes, most_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name.

    Args:
        content: the file.
        most_bytes: of all arrays together, unpacked.

    Raises:
        ValueError: when it is no .npz file of numbers, or larger than that.
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
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise ValueError("it is no .npz archive, or damaged") from error
    return arrays
