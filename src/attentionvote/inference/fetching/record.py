"""The record of fetched bundles and their versions: how a cell knows them when the registry is away."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from pathlib import Path

from attentionvote.files import sync
from attentionvote.inference.fetching.reference import Reference, RegistryVersion

NAME = "registry.json"
_FORMAT = 1
_MOST_BYTES = 1024 * 1024
_MOST_ENTRIES = 32


class FetchRecord:
    """The file ``registry.json`` of a folder, read once.

    An alias counts only what this alias named; a pin also counts what an alias of the same model named as its version,
    because a version is the same thing by whatever name it was asked for.

    Args:
        folder: the file's. A file that is damaged or of another format counts as none.
        reference: whose versions are asked for.
    """

    def __init__(self, folder: Path, reference: Reference) -> None:
        self._folder, self._reference = folder, reference
        self._entries = _read(folder / NAME)

    def versions(self) -> list[RegistryVersion]:
        """The versions of the reference, newest first; of a pin at most one."""
        versions = [version for asked, version in reversed(self._entries) if asked == str(self._reference)]
        if self._reference.version is None:
            return versions
        same = (self._reference.name, self._reference.version)
        return [*versions, *(version for _, version in reversed(self._entries) if version[:2] == same)][:1]

    def newest(self) -> RegistryVersion | None:
        """The version that the reference named last."""
        return next(iter(self.versions()), None)

    def origin_of(self, digest: str) -> RegistryVersion | None:
        """The newest version of the reference that is this bundle; None when none is."""
        return next((version for version in self.versions() if version.digest == digest), None)

    def digests(self) -> list[str]:
        """Every bundle of every reference, newest first, each once."""
        return list(dict.fromkeys(version.digest for _, version in reversed(self._entries)))

    def add(self, version: RegistryVersion, keep: Collection[str] = ()) -> None:
        """Write down that the reference names this version now, on the disk when this returns.

        Args:
            version: becomes the newest.
            keep: digests whose entries stay, however old they are.

        Raises:
            OSError: when it cannot be written; the file before is untouched.
        """
        entry = (str(self._reference), version)
        if self._entries and self._entries[-1] == entry:
            return
        entries = [other for other in self._entries if other != entry] + [entry]
        entries = [e for e in entries[:-_MOST_ENTRIES] if e[1].digest in keep] + entries[-_MOST_ENTRIES:]
        content = [{"reference": asked, **version._asdict()} for asked, version in entries]
        new = self._folder / f"fetching-{NAME}"
        new.write_text(json.dumps({"format": _FORMAT, "bundles": content}, indent=1), encoding="utf-8")
        sync(new)
        os.replace(new, self._folder / NAME)
        sync(self._folder)
        self._entries = entries


def _read(path: Path) -> list[tuple[str, RegistryVersion]]:
    try:
        with path.open("rb") as file:
            content = json.loads(file.read(_MOST_BYTES))
        if content["format"] != _FORMAT:
            return []
        return [
            (str(e["reference"]), RegistryVersion(str(e["name"]), str(e["version"]), str(e["digest"])))
            for e in content["bundles"]
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
