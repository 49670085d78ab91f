"""Files and folders that survive a kill: written whole or not at all, one process a folder, one cache folder."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

log = logging.getLogger("attentionvote.files")


class FolderUnavailable(ValueError):
    """A folder for results cannot be written, or another process works in it; the message is one sentence."""


def write_whole(path: Path, text: str) -> None:
    """Write a text; its folder is made."""
    whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline=""))


def whole(path: Path, write: Callable[[Path], object]) -> None:
    """Have ``write`` make a file under another name of the same kind, and give it its own; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove what killed processes left of a file that ``whole`` writes; nobody may be writing it now."""
    for pattern in (f".{path.stem}.*{path.suffix}", f".{path.name}.*"):  # the second are of version 0.1
        for leftover in path.parent.glob(pattern):
            leftover.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk, where they survive a power cut."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all."""
    write_whole(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file; None when there is no such file, or, with a warning, when it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        content = None
    if not isinstance(content, dict):
        log.warning("%s is damaged and is passed over", path)
        return None
    return content


@contextmanager
def locked_folder(folder: Path, outputs: str, work: str, setting: str = "outputs") -> Iterator[None]:
    """Make the folder and be the only process in it.

    Args:
        folder: created when missing.
        outputs: the setting's value, for the sentence when it cannot be written.
        work: what is done there, for the sentence when another process does it.
        setting: its name.

    Raises:
        FolderUnavailable: when the folder cannot be written, or another process is in it.
    """
    import fcntl  # of Unix; what only reads and writes needs no locks

    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise FolderUnavailable(f"{setting}={outputs} cannot be written: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the kernel, also on kill -9
        except BlockingIOError as error:
            raise FolderUnavailable(f"another process is at this {work} ({folder}): wait for it, or end it") from error
        yield


@contextmanager
def waiting_lock(path: Path) -> Iterator[None]:
    """Wait until no other process holds this file, and hold it; its folder is made."""
    import fcntl

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released by the kernel, also on kill -9
        yield


def is_locked(folder: Path) -> bool:
    """Whether a process is in the folder; False when there is no such folder."""
    import fcntl

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


def cache_folder() -> Path:
    """Where things computed once per machine are kept: ``ATTENTIONVOTE_CACHE``, else the user's cache folder."""
    if named := os.environ.get("ATTENTIONVOTE_CACHE"):
        return Path(named)
    if named := os.environ.get("XDG_CACHE_HOME"):
        return Path(named) / "attentionvote"
    try:
        return Path.home() / ".cache" / "attentionvote"
    except RuntimeError:  # a user without a home; libraries are loaded from nowhere that others may write to
        return Path(f"/run/user/{os.getuid()}/attentionvote")
