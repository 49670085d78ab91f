"""One process at a time in a folder of results."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from configuration import ConfigurationError


@contextmanager
def locked_folder(folder: Path, outputs: str, work: str, setting: str = "outputs") -> Iterator[None]:
    """Make the folder and be the only process in it.

    Args:
        folder: created when missing.
        outputs: the setting's value, for the sentence when it cannot be written.
        work: what is done there, for the sentence when another process does it.
        setting: its name.

    Raises:
        ConfigurationError: when the folder cannot be written, or another process is in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise ConfigurationError(f"{setting}={outputs} cannot be written: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the kernel, also on kill -9
        except BlockingIOError as error:
            raise ConfigurationError(f"another process is at this {work} ({folder}): wait for it, or end it") from error
        yield


def is_locked(folder: Path) -> bool:
    """Whether a process is in the folder; False when there is no such folder."""
    try:
        lock = (folder / ".lock").open("r+")
    except OSError:
        return False
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
