"""The last bundles that served well, kept on the cell's own disk: what it starts from when nothing else is there.

Layout of the folder: ``kept/00000012-3fa9c1d2e4b5`` are verified copies, the highest number is the newest, two at
most; ``staging-*`` are copies in the making; ``lock`` belongs to the server that runs. A copy gets its name in
``kept`` by one rename after everything in it has reached the disk, so whatever stands there is whole, and a server
that is killed at any moment leaves the copies before it untouched.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from attentionvote.files import sync
from attentionvote.inference.bundles.bundle import Bundle, Trusted, load_bundle
from attentionvote.inference.bundles.manifest import MANIFEST, SIGNATURE, files_in, most_bytes, opened, read_file
from attentionvote.inference.errors import InputError
from attentionvote.inference.fetching.reference import SCHEME, Reference
from attentionvote.inference.home_folder import home_folder

STATE_VARIABLE = "ATTENTIONVOTE_STATE"
COPIES = 2
_NAME = re.compile(r"(\d{8})-([0-9a-f]{12})")


def default_state(source: Path | Reference) -> Path:
    """The state folder of a served path or reference: one folder each, below ``ATTENTIONVOTE_STATE``.

    Without the variable they lie below ``~/.local/state/attentionvote``. The name follows the path as it was given,
    links unresolved, because that is what stays the same when the bundle behind it changes.

    Raises:
        InputError: when there is neither the variable nor a home.
    """
    root = home_folder(STATE_VARIABLE, ".local/state", "--state")
    if isinstance(source, Reference):  # wherever the server is started from
        absolute = str(source)
        name = absolute.removeprefix(SCHEME)
    else:
        absolute = os.path.abspath(source)
        name = os.path.basename(absolute)
    key = hashlib.sha256(os.fsencode(absolute)).hexdigest()[:8]
    stem = re.sub(r"[^A-Za-z0-9._-]", "_", name)[:40] or "bundle"
    return root / f"{stem}-{key}"


class LastKnownGood:
    """The copies of one server.

    Args:
        folder: made when missing; belongs to this server until :meth:`close`.

    Raises:
        InputError: when another server holds the folder.
        OSError: when it cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._copies = folder / "kept"
        self._copies.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._lock)
            raise InputError(
                f"the state folder {folder} must belong to one server, but another one that runs holds it: "
                "name another with --state"
            ) from error
        # Only now: nobody else is at work here. What a killed server left unfinished was never anybody's.
        for unfinished in folder.glob("staging-*"):
            shutil.rmtree(unfinished, ignore_errors=True)

    def close(self) -> None:
        """Give the folder back."""
        os.close(self._lock)

    def entries(self) -> list[Path]:
        """The copies, newest first."""
        with suppress(OSError):
            return sorted((p for p in self._copies.iterdir() if _NAME.fullmatch(p.name)), reverse=True)
        return []

    def keep(self, source: Path, bundle: Bundle, trusted: Trusted) -> None:
        """Make a bundle the newest copy and forget all but the two newest.

        Args:
            source: the folder it was loaded from.
            bundle: what was loaded; the copy must be the same.
            trusted: the key that the copy is verified against.

        Raises:
            OSError: when it cannot be written (a full disk, say); the copies before are untouched.
            BundleError: when the folder is no longer what was loaded.
        """
        self._copies.mkdir(parents=True, exist_ok=True, mode=0o700)  # somebody may have removed it meanwhile
        entries = self.entries()
        number = 1 + (int(entries[0].name.partition("-")[0]) if entries else 0)
        target = self._copies / f"{number:08d}-{bundle.digest[:12]}"
        same = next((p for p in entries if p.name.endswith(target.name[9:]) and _intact(p, bundle, trusted)), None)
        if same is not None and same == entries[0]:
            return
        if same is not None:  # a bundle from before serves again
            os.rename(same, target)
        else:
            with self._staging() as staging:
                _copy(source, staging)
                if load_bundle(staging, trusted).digest != bundle.digest:
                    raise OSError(f"{source} was exchanged while it was copied")
                os.rename(staging, target)
        sync(self._copies)
        damaged = {p for p in entries if p.name.endswith(target.name[9:])} - {target}
        others = [p for p in self.entries() if p not in damaged]
        for old in [*damaged, *others[COPIES:]]:
            with suppress(OSError), self._staging() as staging:
                os.rename(old, staging / old.name)  # so that half a copy never stands among the whole ones

    @contextmanager
    def _staging(self) -> Iterator[Path]:
        """A folder for a copy in the making; whatever still has this name at the end is removed."""
        staging = Path(tempfile.mkdtemp(prefix="staging-", dir=self.folder))
        try:
            yield staging
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def _intact(copy: Path, bundle: Bundle, trusted: Trusted) -> bool:
    with suppress(ValueError):
        return load_bundle(copy, trusted).digest == bundle.digest
    return False


def _copy(source: Path, target: Path) -> None:
    """Copy a bundle's files and wait until they are on the disk."""
    folders = {target}
    with opened(source) as handle:
        for name in files_in(handle, source):
            small = name in (MANIFEST, SIGNATURE)
            content = read_file(handle, name, most_bytes(MANIFEST if small else name), source)
            path = target / name
            path.parent.mkdir(parents=True, exist_ok=True)
            folders |= {path.parent, *(p for p in path.parents if p.is_relative_to(target))}
            with path.open("xb") as file:
                file.write(content)
            sync(path)
    for folder in folders:
        sync(folder)
