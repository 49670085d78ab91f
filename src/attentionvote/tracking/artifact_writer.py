"""Artefacts (checkpoints, figures, texts) are staged at once and stored by a background thread."""

from __future__ import annotations

import itertools
import logging
import os
import shutil
import tempfile
import threading
import time
import urllib.parse
import urllib.request
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

RETRY_S = 30.0


def local_folder(artifact_uri: str) -> Path | None:
    """Folder of a run's artefacts when they lie on this machine, None when a server keeps them."""
    parts = urllib.parse.urlsplit(artifact_uri)
    if parts.scheme not in ("", "file"):  # a server's artefacts are "mlflow-artifacts:/...", a bucket's "s3://..."
        return None
    return Path(urllib.request.url2pathname(parts.path)) if parts.scheme else Path(artifact_uri)


def check_artifact_name(name: str) -> str:
    """The name itself when it is a relative path inside the run.

    Raises:
        ValueError: it is empty, absolute or leaves the run.
    """
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts:
        raise ValueError(f"an artefact's name must be a relative path inside the run, got {name!r}")
    return str(path)


class ArtifactWriter:
    """Stores files under stable names: a new file replaces the older one of its name.

    The source is copied when it is handed over, because Lightning deletes and rewrites checkpoints. (A hard link
    would be free, but Lightning rewrites in place when the temporary folder is another file system.) A newer file
    of a name overtakes an older one that still waits. Failures (disk full, server away) cost one warning and are
    tried again.

    Args:
        client: of the store.
        run_id: the run.
        artifact_uri: of the run; a ``file:`` URI is written directly, by atomic rename.
    """

    def __init__(self, client: MlflowClient, run_id: str, artifact_uri: str, retry_s: float = RETRY_S) -> None:
        self._client, self._run_id, self._retry_s = client, run_id, retry_s
        self._folder = local_folder(artifact_uri)
        # Beside a local store, so that the last step is a rename; a fixed name per run, so that a resume cleans up
        # what a kill -9 left.
        parent = self._folder.parents[1] if self._folder else Path(tempfile.gettempdir())
        self._staging = parent / f".staging-{run_id}"
        shutil.rmtree(self._staging, ignore_errors=True)
        self._pending: dict[str, Path] = {}  # name -> staged file
        self._unstaged: dict[str, Path] = {}  # name -> source that could not be copied yet
        self._counter = itertools.count()
        self._changed = threading.Condition()
        self._stop = self._hurry = self._storing = self._failing = False
        self._thread = threading.Thread(target=self._store_forever, name="artifact-writer", daemon=True)
        self._thread.start()

    def put_file(self, source: Path, name: str) -> None:
        """Store a copy of a file under a name; returns when the copy is staged."""
        name = check_artifact_name(name)
        staged = self._staging_path(name)
        try:
            staged.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, staged)
        except OSError as error:
            staged.unlink(missing_ok=True) if staged.parent.is_dir() else None
            with self._changed:
                self._unstaged[name] = source
            self._warn(name, error)
            return
        self._enqueue(name, staged)

    def put_bytes(self, data: bytes, name: str) -> None:
        """Store bytes under a name; dropped with a warning when they cannot even be staged."""
        name = check_artifact_name(name)
        staged = self._staging_path(name)
        try:
            staged.parent.mkdir(parents=True, exist_ok=True)
            staged.write_bytes(data)
        except OSError as error:
            self._warn(name, error)
            return
        self._enqueue(name, staged)

    def flush(self, timeout_s: float) -> bool:
        """Store everything that waits; False when that did not succeed within the time."""
        for name, source in list(self._unstaged.items()):
            with self._changed:
                self._unstaged.pop(name, None)
            if source.is_file():
                self.put_file(source, name)
        deadline = time.monotonic() + timeout_s
        with self._changed:
            self._hurry = bool(self._pending)
            self._changed.notify_all()
            while self._pending or self._storing:
                left = deadline - time.monotonic()
                if left <= 0 or not self._thread.is_alive():
                    return False
                self._changed.wait(min(left, 0.2))
        return not self._unstaged

    def close(self, timeout_s: float, grace_s: float = 600.0) -> list[str]:
        """Store what is left and stop the thread; returns the names that could not be stored.

        Args:
            timeout_s: how long a failing store is tried.
            grace_s: how long a slow one that still works may take.
        """
        start = time.monotonic()
        while not self.flush(min(timeout_s, 5.0)):
            spent = time.monotonic() - start
            if spent > grace_s or (spent > timeout_s and self._failing):
                break
        with self._changed:
            self._stop = True
            self._changed.notify_all()
        self._thread.join(timeout=1.0)
        shutil.rmtree(self._staging, ignore_errors=True)
        return sorted({*self._pending, *self._unstaged})

    def _staging_path(self, name: str) -> Path:
        return self._staging / str(next(self._counter)) / PurePosixPath(name).name

    def _enqueue(self, name: str, staged: Path) -> None:
        with self._changed:
            older = self._pending.pop(name, None)
            self._unstaged.pop(name, None)
            self._pending[name] = staged
            self._changed.notify_all()
        if older is not None:
            older.unlink(missing_ok=True)

    def _warn(self, name: str, error: Exception) -> None:
        if not self._failing:
            reason = str(error).strip().split("\n")[0]
            log.warning("%s could not be stored (%s); training goes on, it is tried again later", name, reason)
        self._failing = True

    def _store_forever(self) -> None:
        while True:
            with self._changed:
                while not self._pending and not self._stop:
                    self._changed.wait()
                if self._stop:
                    return
                name, staged = next(iter(self._pending.items()))
                del self._pending[name]
                self._storing = True
                self._hurry = False
            stored = self._store(name, staged)
            with self._changed:
                if not stored and name not in self._pending:
                    self._pending[name] = staged  # at the end of the line, unless a newer one came meanwhile
                self._storing = False
                self._changed.notify_all()
                if not stored and not self._hurry and not self._stop:
                    self._changed.wait_for(lambda: self._hurry or self._stop, self._retry_s)

    def _store(self, name: str, staged: Path) -> bool:
        try:
            if self._folder is not None:
                target = self._folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(staged, target)
            else:
                parent = PurePosixPath(name).parent
                self._client.log_artifact(self._run_id, str(staged), None if str(parent) == "." else str(parent))
                staged.unlink(missing_ok=True)
        except Exception as error:  # whatever is wrong with the store, training goes on
            if not staged.exists():  # overtaken by a newer file of the same name
                return True
            self._warn(name, error)
            return False
        if self._failing:
            log.warning("artefacts can be stored again")
        self._failing = False
        return True
