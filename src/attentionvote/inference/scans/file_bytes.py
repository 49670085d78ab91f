"""The content of an input file, bounded."""

from __future__ import annotations

from pathlib import Path

from attentionvote.inference.errors import InputError

MOST_INPUT_BYTES = 512 * 1024 * 1024


def file_bytes(source: Path | str | bytes, name: str = "") -> tuple[bytes, str]:
    """Content and name (for messages) of a file that is given by its path or its content.

    Raises:
        InputError: when it cannot be read, is empty, or larger than 512 MiB.
    """
    if isinstance(source, bytes):
        content, name = source, name or "the file"
    else:
        path = Path(source)
        name = name or str(path)
        try:
            with path.open("rb") as file:
                content = file.read(MOST_INPUT_BYTES + 1)
        except FileNotFoundError as error:
            raise InputError(f"{name} must be a file, but there is none: check the path") from error
        except IsADirectoryError as error:
            raise InputError(f"{name} must be a file, got a folder") from error
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise InputError(f"{name} cannot be read: {reason}") from error
    if len(content) > MOST_INPUT_BYTES:
        raise InputError(f"{name} must have at most {MOST_INPUT_BYTES} bytes, got more: crop or thin it out")
    if not content:
        raise InputError(f"{name} must hold a cloud or a depth image, but it is empty")
    return content, name
