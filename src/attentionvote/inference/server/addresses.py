"""The addresses of the servers that a user runs on this machine, so that a health check need not be told any.

Each server leaves a file in a folder of its user and holds a lock on it as long as it lives. Whatever ends the process
lets go of the lock, so the file of a dead server is told from that of a living one, whoever has its process number now.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from pathlib import Path

_FILES, _MOST_BYTES = "serve-*.url", 1000


class Announcement:
    """The file of a running server; it is removed when the server ends in order.

    Args:
        url: under which the server can be asked on this machine.

    Raises:
        OSError: when no file can be written.
    """

    def __init__(self, url: str) -> None:
        folder = _folder()
        folder.mkdir(mode=0o700, exist_ok=True)
        _check_ours(folder)
        for old in folder.glob(_FILES):
            if _living(old) is None:
                old.unlink(missing_ok=True)
        name = f"serve-{os.urandom(8).hex()}.url"
        unfinished, self._path = folder / f".{name}", folder / name
        self._handle = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._handle, fcntl.LOCK_EX)
        os.write(self._handle, url.encode())
        # Under its final name only once it is locked: nobody takes it for a dead server's.
        os.rename(unfinished, self._path)

    def withdraw(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)
        os.close(self._handle)


def local_url(scheme: str, host: str, port: int) -> str:
    """Under which address this machine itself asks a server that listens on a host."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


def running_servers() -> list[str]:
    """The addresses of this user's servers that live, on this machine or in this container."""
    folder = _folder()
    try:
        _check_ours(folder)
    except OSError:
        return []
    return sorted(url for url in map(_living, folder.glob(_FILES)) if url)


def _folder() -> Path:
    """In a folder for temporary files, which a read-only container has as well, and by user."""
    return Path(os.environ.get("TMPDIR") or "/tmp") / f"attentionvote-{os.getuid()}"


def _check_ours(folder: Path) -> None:
    """Nobody else may have made the folder, or may write to it: who does could answer for the server."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise PermissionError(f"{folder} must be a folder of this user that nobody else can write to")


def _living(path: Path) -> str | None:
    """The address in a file whose server lives; None when it is dead."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return None
        return os.read(handle, _MOST_BYTES).decode("utf-8", "replace")
    finally:
        os.close(handle)
