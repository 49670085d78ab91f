"""The content of an input file, bounded."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import TypeAlias

from attentionvote.inference.errors import InputError
from attentionvote.inference.scans.limits import MOST_INPUT_BYTES

Content: TypeAlias = bytes | bytearray | memoryview | mmap.mmap


def file_bytes(path: Path | str, name: str = "") -> tuple[bytes, str]:
    """Content and name (for messages; the path when none is given) of a file.

    Raises:
        InputError: when it cannot be read, is empty, or larger than 512 MiB.
    """
    name = name or str(path)
    try:
        with Path(path).open("rb") as file:
            content = file.read(MOST_INPUT_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f"{name} must be a file, but there is none: check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{name} must be a file, got a folder") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{name} cannot be read: {reason}") from error
    _check_size(content, name)
    return content, name


def content_view(source: Path | str | Content, name: str = "") -> tuple[memoryview, str]:
    """Bytes and name (for messages) of a file that is given by its path, or by its content, which is not copied.

    Args:
        source: path, or contiguous content.
        name: of the content.

    Raises:
        InputError: when it cannot be read, is empty, or larger than 512 MiB.
    """
    if isinstance(source, (str, Path)):
        content, name = file_bytes(source, name)
        return memoryview(content), name
    view, name = memoryview(source).cast("B"), name or "the file"
    _check_size(view, name)
    return view, name


def _check_size(content: bytes | memoryview, name: str) -> None:
    if len(content) > MOST_INPUT_BYTES:
        raise InputError(f"{name} must have at most {MOST_INPUT_BYTES} bytes, got more: crop or thin it out")
    if not content:
        raise InputError(f"{name} must hold a cloud or a depth image, but it is empty")
