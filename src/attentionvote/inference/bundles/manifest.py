"""The manifest of a bundle: every file with its size and sha256, written once, compared with the folder on every load.

Files are read through the folder's handle and no symbolic link is followed inside it, so a bundle that is exchanged
while it is read cannot mix with the one before. What is hashed is what is returned: nothing is read twice.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from attentionvote.inference.bundles.signature import sign
from attentionvote.inference.errors import BundleError

MANIFEST, SIGNATURE = "manifest.json", "manifest.sig"
MODEL, CARD, MESH, GOLDEN = "model.onnx", "card.json", "part.ply", "golden"
# What MLflow keeps beside a registered bundle's files, or writes beside them when it loads them: no part of the bundle,
# never read here. (By these names alone: anything else that the manifest does not name is refused.)
BESIDE = frozenset({"MLmodel", "python_env.yaml", "requirements.txt", "registered_model_meta"})
FORMAT = 1
_MIB = 1024 * 1024
# A full-size model has about 10 MiB and a cloud less than one: these bounds only keep a wrong folder from being read.
MOST_MODEL_BYTES, MOST_CARD_BYTES, MOST_FILE_BYTES, MOST_OTHER_BYTES = 512 * _MIB, _MIB, 64 * _MIB, 256 * _MIB
MOST_MANIFEST_BYTES, MOST_FILES, MOST_DEPTH = _MIB, 256, 3
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_AGAIN = "copy or export the bundle again"


class Entry(NamedTuple):
    """Size in bytes and sha256 (hexadecimal) of a file."""

    bytes: int
    sha256: str


def most_bytes(name: str) -> int:
    """The largest size accepted for a file of a bundle."""
    return {MODEL: MOST_MODEL_BYTES, CARD: MOST_CARD_BYTES}.get(name, MOST_FILE_BYTES)


def canonical(content: Any) -> bytes:
    """Canonical JSON: the same content, the same bytes."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode()


def write_manifest(folder: Path, private_key: Ed25519PrivateKey) -> None:
    """Hash every file of a bundle's folder, then write its manifest and the manifest's signature.

    Raises:
        BundleError: when the folder is no complete bundle, or holds what no bundle may hold.
    """
    with opened(folder) as handle:
        names = [name for name in files_in(handle, folder) if name not in {MANIFEST, SIGNATURE, *BESIDE}]
        entries: dict[str, Entry] = {}
        for name in names:
            _check_name(name, folder)
            content = read_file(handle, name, most_bytes(name), folder)
            entries[name] = Entry(len(content), hashlib.sha256(content).hexdigest())
        _check_complete(entries)
        manifest = canonical({"bundle": FORMAT, "files": {name: entry._asdict() for name, entry in entries.items()}})
        for name, content in ((MANIFEST, manifest), (SIGNATURE, sign(manifest, private_key))):
            temporary = folder / f".{name}.{os.getpid()}"
            temporary.write_bytes(content)
            temporary.replace(folder / name)


def parse_manifest(content: bytes) -> dict[str, Entry]:
    """The files that a manifest names.

    Raises:
        BundleError: when it is not canonical JSON of the right shape, names impossible files, or misses one.
    """
    try:
        fields = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{MANIFEST} must be JSON, but it cannot be parsed: {_AGAIN}") from error
    if not isinstance(fields, dict) or set(fields) != {"bundle", "files"} or not isinstance(fields["files"], dict):
        raise BundleError(f'{MANIFEST} must be {{"bundle": {FORMAT}, "files": {{...}}}}, got something else: {_AGAIN}')
    if fields["bundle"] != FORMAT or isinstance(fields["bundle"], bool):
        raise BundleError(
            f"{MANIFEST} must be of bundle format {FORMAT}, got {str(fields['bundle'])[:20]}: "
            "export the bundle again with this version"
        )
    if len(fields["files"]) > MOST_FILES:
        raise BundleError(f"{MANIFEST} must name at most {MOST_FILES} files, got {len(fields['files'])}")
    entries = {}
    for name, entry in fields["files"].items():
        _check_name(name, MANIFEST)
        entries[name] = _entry(name, entry)
    if canonical(fields) != content:
        raise BundleError(f"{MANIFEST} must be canonical JSON (sorted, no spaces), got another text: {_AGAIN}")
    _check_complete(entries)
    return entries


def _entry(name: str, entry: object) -> Entry:
    if isinstance(entry, dict) and set(entry) == {"bytes", "sha256"}:
        size, digest = entry["bytes"], entry["sha256"]
        whole = isinstance(size, int) and not isinstance(size, bool) and size >= 0
        if whole and isinstance(digest, str) and _SHA256.fullmatch(digest):
            return Entry(size, digest)
    raise BundleError(f"{MANIFEST} must give bytes and sha256 of {name}, got something else: {_AGAIN}")


def _check_name(name: str, where: object) -> None:
    if not _NAME.fullmatch(name) or name.count("/") >= MOST_DEPTH or len(name) > 200:
        raise BundleError(
            f"{where} holds the name {name[:80]!r}, but a bundle's files have plain relative names of letters, digits, "
            "'.', '_' and '-': export the bundle again"
        )
    if name in (MANIFEST, SIGNATURE):
        raise BundleError(f"{where} must not list {name}: {_AGAIN}")


def _check_complete(entries: Mapping[str, Entry]) -> None:
    for name in (MODEL, CARD, MESH):
        if name not in entries:
            raise BundleError(f"a bundle must hold {name}, but there is none: export it again")
    if not any(name.startswith(f"{GOLDEN}/") for name in entries):
        raise BundleError(
            f"a bundle must hold at least one {GOLDEN}/NAME.npz for the self-test, got none: export it again"
        )
    for name, entry in entries.items():
        if entry.bytes > most_bytes(name):
            raise BundleError(f"{name} must have at most {most_bytes(name)} bytes, got {entry.bytes}")
    total = sum(entry.bytes for name, entry in entries.items() if name != MODEL)
    if total > MOST_OTHER_BYTES:
        raise BundleError(f"the files beside {MODEL} must have at most {MOST_OTHER_BYTES} bytes together, got {total}")


@contextmanager
def opened(folder: Path) -> Iterator[int]:
    """A handle of a bundle's folder; the folder itself may be a link (``current -> bundle-7``).

    Raises:
        BundleError: when there is no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except NotADirectoryError as error:
        raise BundleError(f"{folder} must be a bundle's folder, got a file: name the folder it lies in") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise BundleError(f"{folder} must be a bundle's folder, but it cannot be opened ({reason})") from error
    try:
        yield handle
    finally:
        os.close(handle)


def files_in(handle: int, folder: Path, below: str = "", depth: int = 1) -> list[str]:
    """The names of all files below a folder's handle, sorted.

    Raises:
        BundleError: on symbolic links, devices, too deep or too many files.
    """
    names: list[str] = []
    for entry in sorted(os.scandir(handle), key=lambda entry: entry.name):
        name = below + entry.name
        if entry.is_symlink():
            raise BundleError(f"{folder}: {name} must be a plain file, got a symbolic link: {_AGAIN}")
        if entry.is_dir(follow_symlinks=False):
            if depth >= MOST_DEPTH:
                raise BundleError(f"{folder}: {name} lies too deep for a bundle: remove it or export again")
            inner = _open(handle, entry.name, os.O_DIRECTORY, name, folder)
            try:
                names += files_in(inner, folder, f"{name}/", depth + 1)
            finally:
                os.close(inner)
        elif entry.is_file(follow_symlinks=False):
            names.append(name)
        else:
            raise BundleError(f"{folder}: {name} must be a plain file, got a device or pipe: {_AGAIN}")
        if len(names) > MOST_FILES + 2 + len(BESIDE):
            raise BundleError(f"{folder} must hold at most {MOST_FILES} files, got more: is it a bundle's folder?")
    return names


def read_file(handle: int, name: str, most: int, folder: Path) -> bytes:
    """The content of a file below a folder's handle.

    Raises:
        BundleError: when it is missing, no plain file, or has more than ``most`` bytes.
    """
    inner = os.dup(handle)
    try:
        *folders, last = name.split("/")
        for part in folders:
            deeper = _open(inner, part, os.O_DIRECTORY, name, folder)
            os.close(inner)
            inner = deeper
        file = _open(inner, last, os.O_NONBLOCK, name, folder)  # a pipe must not make the reader wait
    finally:
        os.close(inner)
    try:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            raise BundleError(f"{folder}: {name} must be a plain file: {_AGAIN}")
        with os.fdopen(file, "rb", closefd=False) as stream:
            content = stream.read(most + 1)
    except OSError as error:
        raise BundleError(f"{folder}: {name} cannot be read ({error.strerror}): {_AGAIN}") from error
    finally:
        os.close(file)
    if len(content) > most:
        raise BundleError(f"{folder}: {name} must have at most {most} bytes, got more: is it a bundle's folder?")
    return content


def _open(handle: int, part: str, flags: int, name: str, folder: Path) -> int:
    try:
        return os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | flags, dir_fd=handle)
    except FileNotFoundError as error:
        raise BundleError(f"{folder}: {name} is missing: {_AGAIN}") from error
    except OSError as error:  # ELOOP: a symbolic link
        raise BundleError(f"{folder}: {name} must be a plain readable file ({error.strerror}): {_AGAIN}") from error
