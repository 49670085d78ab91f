"""Bundles fetched from a registry, in a folder on the cell's own disk, and the link to the one that it names now.

Layout: ``3fa9c1d2e4b5`` is a bundle, named after the first digits of its digest; ``latest`` is a relative link to
one; ``registry.json`` says which version of which model each one is; ``fetching-*`` are bundles in the making and
``lock`` belongs to whoever makes one. A bundle gets its name by one rename after everything in it was checked and has
reached the disk, so whatever has such a name is whole, and a process that is killed at any moment spoils nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from attentionvote.files import sync
from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.bundles.manifest import MANIFEST, MOST_MANIFEST_BYTES, SIGNATURE, Entry, parse_manifest
from attentionvote.inference.bundles.signature import verify
from attentionvote.inference.errors import BundleError
from attentionvote.inference.fetching.record import FetchRecord
from attentionvote.inference.fetching.reference import PREFIX, Reference, RegistryVersion
from attentionvote.inference.fetching.registry import Registry

LATEST = "latest"
DIGITS = 12  # of the digest in a folder's name
COPIES = 2


class FetchedBundles:
    """The fetched bundles of one folder, for one reference.

    Args:
        folder: made when missing.
        reference: whose bundles these are; bundles of other references in the folder are left alone until they are
            no longer among the newest.
        key: must have signed every bundle.

    Raises:
        OSError: when the folder cannot be made or written.
    """

    def __init__(self, folder: Path, reference: Reference, key: Ed25519PublicKey) -> None:
        self.folder, self.reference = folder, reference
        self.link = folder / LATEST
        self._key = key
        folder.mkdir(parents=True, exist_ok=True)
        self._record = FetchRecord(folder, reference)
        self._whole: set[str] = set()  # digests that were verified on disk by this process

    def origin_of(self, digest: str) -> RegistryVersion | None:
        """The version that a bundle is under this reference; None when the reference never named it."""
        return self._record.origin_of(digest)

    def pinned(self) -> RegistryVersion | None:
        """The version that a pin means, once it has been fetched and while it is there and whole; None for an alias."""
        version = self._record.newest() if self.reference.version is not None else None
        return version if version is not None and self._intact(version) else None

    def restore(self) -> None:
        """Let the link lead to the newest bundle of this reference that is there, or nowhere.

        Without a question to the registry: what was linked may belong to another reference. A link that is right is
        left alone, so that a cell starts on a disk that can no longer be written.
        """
        there = [v for v in self._record.versions() if (self.folder / v.digest[:DIGITS]).is_dir()]
        if not there and self.link.is_symlink():
            with self._locked():
                self.link.unlink(missing_ok=True)
        elif there and self.target() != there[0].digest[:DIGITS]:
            with self._locked():
                self._point(there[0])

    def take(self, registry: Registry, version: RegistryVersion, serving: Collection[str] = ()) -> tuple[Path, bool]:
        """Fetch a version unless it is there, let the link lead to it, and forget old ones.

        Args:
            registry: that holds it.
            version: what the reference names now.
            serving: digests of bundles that must be kept beside the two newest.

        Returns:
            The bundle's folder, and whether it had to be fetched.

        Raises:
            BundleError: when it is no bundle that may serve; nothing has changed then.
            RegistryError: when the registry goes away meanwhile.
            OSError: when it cannot be written.
        """
        with self._locked():
            self._record = FetchRecord(self.folder, self.reference)  # another process may have fetched meanwhile
            self._check_pin(version)
            target = self.folder / version.digest[:DIGITS]
            fetched = not self._intact(version)
            if fetched:
                self._fetch(registry, version, target)
            self._record.add(version, keep=serving)
            self._point(version)
            self._prune({*self._record.digests()[:COPIES], *serving})
        return target, fetched

    def _check_pin(self, version: RegistryVersion) -> None:
        """A model that was deleted and made again counts its versions from 1: the number alone is no pin."""
        before = self._record.newest()
        if self.reference.version is not None and before is not None and before.digest != version.digest:
            raise BundleError(
                f"{version} must be the bundle {before.digest[:DIGITS]} that it was when it was pinned here, got "
                f"{version.digest[:DIGITS]}: pin another version, or remove {self.folder} to pin this one anew"
            )

    def _fetch(self, registry: Registry, version: RegistryVersion, target: Path) -> None:
        staging = Path(tempfile.mkdtemp(prefix="fetching-", dir=self.folder))
        try:
            bundle = staging / "bundle"
            bundle.mkdir()  # as readable as the process' umask has it, which a temporary folder is not
            fetch(registry, version, self._key, bundle)
            if target.is_dir():  # and damaged
                os.rename(target, staging / "damaged")
            os.rename(bundle, target)
            sync(self.folder)
            self._whole.add(version.digest)
        finally:
            shutil.rmtree(staging, ignore_errors=True)

    def _intact(self, version: RegistryVersion) -> bool:
        target = self.folder / version.digest[:DIGITS]
        if not target.is_dir():
            self._whole.discard(version.digest)
        elif version.digest not in self._whole:
            with contextlib.suppress(BundleError):
                if load_bundle(target, self._key).digest == version.digest:
                    self._whole.add(version.digest)
        return version.digest in self._whole

    def _point(self, version: RegistryVersion) -> None:
        name = version.digest[:DIGITS]
        if self.target() == name:
            return
        new = self.folder / f"fetching-{LATEST}"
        new.unlink(missing_ok=True)
        new.symlink_to(name)
        os.replace(new, self.link)
        sync(self.folder)

    def target(self) -> str | None:
        """The name of the folder that the link leads to; None where there is no link."""
        with contextlib.suppress(OSError):
            return os.readlink(self.link)
        return None

    def _prune(self, keep: Collection[str]) -> None:
        """Remove what was fetched here once and is not kept; whatever else lies in the folder is not ours."""
        names = {digest[:DIGITS] for digest in keep}
        for digest in self._record.digests():
            old = self.folder / digest[:DIGITS]
            if old.name not in names and old.is_dir():
                self._whole.discard(digest)
                gone = Path(tempfile.mkdtemp(prefix="fetching-", dir=self.folder))
                with contextlib.suppress(OSError):
                    os.rename(old, gone / old.name)  # so that half a bundle never has a bundle's name
                shutil.rmtree(gone, ignore_errors=True)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Alone in the folder; what a killed process left unfinished is removed."""
        handle = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            for unfinished in self.folder.glob("fetching-*"):
                if unfinished.is_dir() and not unfinished.is_symlink():
                    shutil.rmtree(unfinished, ignore_errors=True)
                else:
                    unfinished.unlink(missing_ok=True)
            yield
        finally:
            os.close(handle)


def fetch(registry: Registry, version: RegistryVersion, key: Ed25519PublicKey, folder: Path) -> None:
    """Fetch a version's bundle into an empty folder and wait until it is on the disk.

    Manifest and signature come first; no other file is asked for before the trusted key has signed for it, and none is
    read beyond the size that the manifest gives.

    Raises:
        BundleError: when it is no bundle that may serve.
        RegistryError: when the registry goes away meanwhile.
        OSError: when it cannot be written.
    """
    manifest, signature = bytearray(), bytearray()
    for name, content in ((MANIFEST, manifest), (SIGNATURE, signature)):
        for piece in registry.pieces(version, name, MOST_MANIFEST_BYTES):
            content.extend(piece)
    digest = hashlib.sha256(manifest).hexdigest()
    try:
        verify(bytes(manifest), bytes(signature), key)
        entries = parse_manifest(bytes(manifest))
    except BundleError as error:
        raise BundleError(f"{version}: {error}") from error
    if digest != version.digest:
        raise BundleError(
            f"{version} must be the bundle {version.digest[:DIGITS]} of its tag, but its manifest is of bundle "
            f"{digest[:DIGITS]}: register it again with `make promote`"
        )
    for name, entry in sorted(entries.items(), key=lambda item: item[1].bytes):
        _fetch_file(registry, version, name, entry, folder / name)
    for name, content in ((MANIFEST, manifest), (SIGNATURE, signature)):
        with (folder / name).open("xb") as file:
            file.write(content)
        sync(folder / name)
    for below in {folder, *((folder / name).parent for name in entries)}:
        sync(below)
    try:
        part = load_bundle(folder, key).card.part.name
    except BundleError as error:
        raise BundleError(str(error).replace(str(folder), str(version))) from error
    expected = version.name.removeprefix(PREFIX)
    if version.name.startswith(PREFIX) and part != expected:
        raise BundleError(
            f"{version} must hold a model of {expected}, got one of {part}: register it under {PREFIX}{part}"
        )


def _fetch_file(registry: Registry, version: RegistryVersion, name: str, entry: Entry, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    pieces = registry.pieces(version, name, entry.bytes)
    with path.open("xb") as file, contextlib.closing(pieces):
        for piece in pieces:
            digest.update(piece)
            file.write(piece)
        size = file.tell()
    sync(path)
    if size != entry.bytes:
        raise BundleError(f"{version}: {name} must have {entry.bytes} bytes, got {size}: register the bundle again")
    if digest.hexdigest() != entry.sha256:
        raise BundleError(
            f"{version}: {name} must have the sha256 {entry.sha256[:12]}..., but its content was changed: "
            "register the bundle again"
        )
