"""Keys and signatures of bundles: Ed25519, detached, over the bytes of the manifest.

The private key stays with whoever exports; a cell holds the public key only and takes no bundle that another key
signed. A key is named by its fingerprint, the first 16 hexadecimal digits of the sha256 of the raw public key.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from attentionvote.inference.errors import BundleError
from attentionvote.inference.home_folder import home_folder

PRIVATE_NAME, PUBLIC_NAME = "signing.key", "signing.pub"
KEYS_VARIABLE = "ATTENTIONVOTE_KEYS"
ALGORITHM = "ed25519"
_MOST_BYTES = 16 * 1024  # of a key or signature file; real ones have a few hundred


def keys_folder() -> Path:
    """Where the keys lie: the folder that ``ATTENTIONVOTE_KEYS`` names, else ``~/.config/attentionvote``.

    Raises:
        InputError: when there is neither.
    """
    return home_folder(KEYS_VARIABLE, ".config", "--key")


def make_keys(folder: Path) -> tuple[Path, Path]:
    """Make a key pair in ``folder``: ``signing.key`` (PEM PKCS8, mode 0600) and ``signing.pub`` (PEM).

    Nothing is ever overwritten. A private key whose public half is missing (an interrupted call) gets it back.

    Returns:
        The paths of the private and of the public key.

    Raises:
        BundleError: when there is a pair already, or the folder cannot be written.
    """
    private, public = folder / PRIVATE_NAME, folder / PUBLIC_NAME
    if private.exists() and public.exists():
        raise BundleError(
            f"{private} must not exist yet, but it does and keys are never overwritten: "
            "use it, or move both files away to make a new pair"
        )
    if public.exists():
        raise BundleError(
            f"{public} stands without its {PRIVATE_NAME} and keys are never overwritten: "
            "move it away to make a new pair, or make the pair in another folder"
        )
    try:
        if not folder.is_dir():
            folder.mkdir(parents=True, mode=0o700)
        if private.exists():
            key = load_private_key(private)
        else:
            key = Ed25519PrivateKey.generate()
            pem = key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
            if not _create(private, pem, 0o600):
                raise BundleError(f"{private} was made by another process just now: use it")
        # Of one private key every process makes the same public one.
        _create(public, public_pem(key.public_key()), 0o644)
    except OSError as error:
        raise BundleError(
            f"{folder} must be a folder that can be written, but {error.strerror}: name another"
        ) from error
    return private, public


def public_pem(key: Ed25519PublicKey) -> bytes:
    """The PEM text of a public key."""
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def _create(path: Path, content: bytes, mode: int) -> bool:
    """Write a new file, whole or not at all; False when there is one already, which is left as it is."""
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            os.fchmod(file.fileno(), mode)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.link(temporary, path)  # fails where rename would overwrite
    except FileExistsError:
        return False
    finally:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
    return True


def load_private_key(path: Path) -> Ed25519PrivateKey:
    """The private key in a PEM file.

    Raises:
        BundleError: when the file is missing, readable by others, or no Ed25519 private key.
    """
    content = _read(path, "private key", "make one with `attentionvote keys`")
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        raise BundleError(
            f"{path} must be readable by its owner only (mode 600), got mode {mode:o}: "
            f"chmod 600 it, and make a new pair if others may have read it"
        )

    key = _parsed(path, "private", lambda: serialization.load_pem_private_key(content, password=None))
    if not isinstance(key, Ed25519PrivateKey):
        raise BundleError(f"{path} must be an Ed25519 private key, got {type(key).__name__}: make one with `keys`")
    return key


def load_public_key(path: Path) -> Ed25519PublicKey:
    """The public key in a PEM file.

    Raises:
        BundleError: when the file is missing or no Ed25519 public key.
    """
    content = _read(path, "public key", f"copy {PUBLIC_NAME} of whoever signs the bundles there")
    key = _parsed(path, "public", lambda: serialization.load_pem_public_key(content))
    if not isinstance(key, Ed25519PublicKey):
        raise BundleError(f"{path} must be an Ed25519 public key, got {type(key).__name__}")
    return key


def trusted_key(named: Path | str | None) -> Ed25519PublicKey:
    """The public key whose signature bundles must have: of the file named, else ``signing.pub`` in the keys' folder.

    Raises:
        BundleError: when there is none.
        InputError: when nothing says where the keys lie.
    """
    return load_public_key(keys_folder() / PUBLIC_NAME if named is None else Path(named))


def _read(path: Path, what: str, remedy: str) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise BundleError(f"{path} must be a {what}, but it cannot be read ({error.strerror}): {remedy}") from error
    if len(content) > _MOST_BYTES:
        raise BundleError(f"{path} must be a {what} of at most {_MOST_BYTES} bytes, got a larger file: {remedy}")
    return content


def _parsed(path: Path, kind: str, parse: Callable[[], object]) -> object:
    try:
        return parse()
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:  # TypeError: the key is encrypted
        raise BundleError(f"{path} must be an unencrypted {kind} key in PEM form, but it cannot be parsed") from error


def fingerprint(public_key: Ed25519PublicKey) -> str:
    """The name of a key: the first 16 hexadecimal digits of the sha256 of its raw 32 bytes."""
    raw = public_key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return hashlib.sha256(raw).hexdigest()[:16]


def sign(data: bytes, key: Ed25519PrivateKey) -> bytes:
    """The content of the signature file of ``data``: JSON with algorithm, fingerprint and signature."""
    content = {
        "algorithm": ALGORITHM,
        "key": fingerprint(key.public_key()),
        "signature": base64.b64encode(key.sign(data)).decode("ascii"),
    }
    return json.dumps(content, sort_keys=True, separators=(",", ":")).encode("ascii")


def verify(data: bytes, signature_file: bytes, public_key: Ed25519PublicKey) -> None:
    """Check that ``signature_file`` is the trusted key's signature of ``data``.

    Raises:
        BundleError: when it is malformed, made by another key (both are named), or does not fit the data.
    """
    key, signature = _signature(signature_file)
    trusted = fingerprint(public_key)
    if key != trusted:
        raise BundleError(
            f"the bundle must be signed by the trusted key {trusted}, but it is signed by key {key}: "
            f"export it with the trusted key, or trust the other one's {PUBLIC_NAME} if you know whose it is"
        )
    try:
        public_key.verify(signature, data)
    except InvalidSignature as error:
        raise BundleError(
            f"the signature of key {key} does not fit the manifest, so the bundle was changed after it was signed: "
            "copy or export it again"
        ) from error


def _signature(content: bytes) -> tuple[str, bytes]:
    """Fingerprint and raw signature in the content of a signature file."""
    shape = 'JSON {"algorithm": "ed25519", "key": ..., "signature": ...}'
    try:
        if len(content) > _MOST_BYTES:
            raise ValueError("too large")
        fields = json.loads(content)
        if not isinstance(fields, dict) or set(fields) != {"algorithm", "key", "signature"}:
            raise ValueError("other fields")
        if not all(isinstance(value, str) for value in fields.values()):
            raise ValueError("not texts")
        signature = base64.b64decode(fields["signature"], validate=True)
    except (ValueError, RecursionError, binascii.Error) as error:
        raise BundleError(
            f"the signature file must be {shape}, but it is not: copy or export the bundle again"
        ) from error
    if fields["algorithm"] != ALGORITHM:
        raise BundleError(f"the signature's algorithm must be {ALGORITHM}, got {fields['algorithm'][:40]!r}")
    return fields["key"][:64], signature
