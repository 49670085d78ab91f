"""From a folder to a model that may serve: verified, loaded beside the old one, self-tested, kept. Blocking calls."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from attentionvote.inference.answer import DIGEST_LENGTH
from attentionvote.inference.bundles.bundle import Bundle, Trusted, load_bundle
from attentionvote.inference.bundles.manifest import MANIFEST, MOST_MANIFEST_BYTES, files_in, opened, read_file
from attentionvote.inference.errors import BundleError
from attentionvote.inference.fetching.reference import RegistryVersion
from attentionvote.inference.server.model.last_known_good import LastKnownGood
from attentionvote.inference.server.model.serving import Served
from attentionvote.inference.server.worker.workers import Workers


class Mark(NamedTuple):
    """What a folder looked like: another mark means that it is worth another try.

    Attributes:
        folder: where the served path leads.
        digest: sha256 of the manifest; empty when it cannot be read.
        files: name, size and time of every file.
    """

    folder: str
    digest: str
    files: tuple[tuple[str, int, int], ...]


def mark_of(source: Path) -> Mark:
    """The mark of a served path, whatever state it is in. Reads the manifest only."""
    folder = os.path.realpath(source)
    try:
        with opened(Path(folder)) as handle:
            digest = hashlib.sha256(read_file(handle, MANIFEST, MOST_MANIFEST_BYTES, source)).hexdigest()
            files = []
            for name in files_in(handle, source):
                status = os.stat(name, dir_fd=handle, follow_symlinks=False)
                files.append((name, status.st_size, status.st_mtime_ns))
    except (BundleError, OSError) as error:
        return Mark(folder, "", ((str(error), 0, 0),))
    return Mark(folder, digest, tuple(files))


@dataclass(frozen=True)
class BundleLoader:
    """Makes models that may serve.

    Attributes:
        trusted: the key that must have signed a bundle.
        start_workers: with a verified bundle, which they test; politely when another model serves.
        store: where what served well is kept; None when it cannot be kept anywhere.
        origin_of: the registry's version that a digest is, where bundles come from a registry; what has none may not
            serve. None where they come from a path.
    """

    trusted: Trusted
    start_workers: Callable[[Bundle, bool], Workers]
    store: LastKnownGood | None
    origin_of: Callable[[str], RegistryVersion | None] | None = None

    def tested(self, folder: Path, *, polite: bool = False) -> tuple[Bundle, Workers]:
        """A verified bundle and workers that reproduced every golden cloud of it.

        Raises:
            BundleError: with the first thing that is wrong.
        """
        bundle = load_bundle(folder, self.trusted)
        if self.origin_of is not None and self.origin_of(bundle.digest) is None:
            raise BundleError(
                f"{folder} must hold a bundle that the registry named, got {bundle.digest[:DIGEST_LENGTH]}, which it "
                "did not under this reference"
            )
        return bundle, self.start_workers(bundle, polite)

    def from_source(self, source: Path, *, must_keep: bool) -> tuple[Served, OSError | None]:
        """The model of the served path, and why it could not be kept (None: it was, or there is no store).

        Args:
            source: the served path.
            must_keep: let the failure to keep it pass through instead.

        Raises:
            BundleError: when it may not serve.
            OSError: when it could not be kept, but must be.
        """
        bundle, workers = self.tested(source, polite=must_keep)
        failure = None
        try:
            if self.store is not None:
                self.store.keep(source, bundle, self.trusted)
        except OSError as error:
            if must_keep:
                workers.close()
                raise
            failure = error
        except BaseException:  # the folder is no longer what was loaded
            workers.close()
            raise
        saved = self.store is not None and failure is None
        return Served(workers, saved, last_known_good=False, origin=self._origin(bundle)), failure

    def keep(self, source: Path, digest: str) -> bool:
        """Keep a bundle that serves already; False when the path holds another by now.

        Raises:
            OSError, BundleError: when it cannot be kept.
        """
        assert self.store is not None
        bundle = load_bundle(source, self.trusted)
        if bundle.digest != digest:
            return False
        self.store.keep(source, bundle, self.trusted)
        return True

    def last_known_good(self) -> tuple[Served | None, list[str]]:
        """The newest copy that may serve, and what was wrong with newer ones."""
        problems = []
        for entry in self.store.entries() if self.store is not None else []:
            try:
                bundle, workers = self.tested(entry)
            except (BundleError, OSError) as error:
                problems.append(str(error))
            else:
                return Served(workers, saved=True, last_known_good=True, origin=self._origin(bundle)), problems
        return None, problems

    def _origin(self, bundle: Bundle) -> RegistryVersion | None:
        return None if self.origin_of is None else self.origin_of(bundle.digest)
