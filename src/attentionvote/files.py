"""Files and folders that survive a kill: written whole or not at all, one process a folder, one cache folder.

Where something lies whole already nothing is written: a reader needs no right to write, and no room.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

log = logging.getLogger("attentionvote.files")
REMOVED = ".removed-"  # begins the name of a folder that is being removed


class FolderUnavailable(ValueError):
    """A folder for results cannot be written, or another process works in it; the message is one sentence."""


class DiskFull(OSError):
    """A disk has no room left; the message is one sentence with a folder on it."""

    def __str__(self) -> str:
        return str(self.strerror)


def disk_full(error: BaseException, folder: Path | None = None) -> DiskFull | None:
    """The error of a full disk, or of a used-up quota, that this exception tells of; None when it tells of another.

    Args:
        error: by the system; where the folder is named also by SQLite, however it is wrapped.
        folder: that was written to; None: the one that ``error`` names, else the fullest of those that may be meant.
    """
    number = error.errno if isinstance(error, OSError) else None
    by_database = folder is not None and "database or disk is full" in str(error)
    if number not in (errno.ENOSPC, errno.EDQUOT) and not by_database:
        return None
    if isinstance(error, DiskFull):
        return error
    if folder is None and isinstance(error, OSError) and (error.filename2 or error.filename):
        folder = Path(os.fsdecode(error.filename2 or error.filename)).parent
    if folder is None:
        places = [Path(name) for name in ("outputs", "data", ".", tempfile.gettempdir())]
        folder = min(filter(Path.is_dir, places), key=_free_bytes)
    number = number or errno.ENOSPC
    free = _free_bytes(folder)
    return DiskFull(
        number,
        f"the disk of {folder} must have room, but {free:,} bytes are free ({os.strerror(number)}): make room, the "
        "same command goes on from there",
    )


def _free_bytes(folder: Path) -> int:
    """Room for this user on the disk of a folder that may not exist yet."""
    there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    return shutil.disk_usage(there).free


@contextmanager
def naming_full_disk(folder: Path) -> Iterator[None]:
    """Around what writes to a folder.

    Raises:
        DiskFull: instead of the system's error, which names no folder.
    """
    try:
        yield
    except OSError as error:
        full = disk_full(error, folder)
        if full is None or full is error:
            raise
        raise full from error


def write_whole(path: Path, text: str) -> None:
    """Write a text; its folder is made."""
    whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline=""))


def whole(path: Path, write: Callable[[Path], object]) -> None:
    """Have ``write`` make a file under another name of the same kind, and give it its own; its folder is made.

    Raises:
        DiskFull: when there is no room.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with naming_full_disk(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(temporary)
            temporary.replace(path)
    finally:
        with suppress(OSError):  # a folder that was not made holds nothing
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
        DiskFull: when there is no room.
    """
    import fcntl  # of Unix; what only reads and writes needs no locks

    try:
        with naming_full_disk(folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / ".lock").open("w")
    except DiskFull:
        raise
    except OSError as error:
        raise FolderUnavailable(f"{setting}={outputs} cannot be written: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the kernel, also on kill -9
        except BlockingIOError as error:
            raise FolderUnavailable(f"another process is at this {work} ({folder}): wait for it, or end it") from error
        if not _is_at(lock, folder / ".lock"):
            raise FolderUnavailable(f"another process removed this {work} just now ({folder}): start it again")
        yield


@contextmanager
def waiting_lock(path: Path) -> Iterator[None]:
    """Wait until no other process holds this file, and hold it; its folder is made, again when it was removed.

    Raises:
        FolderUnavailable: when its folder cannot be written.
        DiskFull: when there is no room.
    """
    import fcntl

    while True:
        try:
            with naming_full_disk(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
                lock = path.open("w")
        except DiskFull:
            raise
        except OSError as error:
            raise FolderUnavailable(f"{path.parent} cannot be written: {error.strerror or error}") from error
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # released by the kernel, also on kill -9
            if _is_at(lock, path):
                yield
                return


def _is_at(lock: IO[str], path: Path) -> bool:
    """Whether the open file is still the one of this name: its folder may have been removed while it was locked."""
    try:
        return os.path.samestat(os.fstat(lock.fileno()), path.stat())
    except FileNotFoundError:
        return False


def remove_folder(folder: Path, *first: str) -> None:
    """Remove a folder whose lock this process holds: under its name it is there whole or not at all.

    What a kill leaves has a name that begins with ``REMOVED``.

    Args:
        folder: whose parent stays.
        first: the files in it that say it is complete; they are gone before anything else is.
    """
    moved = folder.with_name(REMOVED + folder.name)
    if moved.exists():  # of a killed process
        shutil.rmtree(moved)
    folder.rename(moved)
    for name in first:
        (moved / name).unlink(missing_ok=True)
    shutil.rmtree(moved)


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
