"""Keys and signatures: made once, never overwritten, and a signature that fits nothing else."""

from __future__ import annotations

import hashlib
import json
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.bundles.signature import (
    _create,
    fingerprint,
    keys_folder,
    load_private_key,
    load_public_key,
    make_keys,
    sign,
    verify,
)
from attentionvote.inference.errors import BundleError

KEY, OTHER = Ed25519PrivateKey.from_private_bytes(bytes(32)), Ed25519PrivateKey.from_private_bytes(bytes(31) + b"1")
DATA = b'{"bundle":1}'


def test_keys_are_a_pair_and_the_private_one_is_its_owners(tmp_path: Path) -> None:
    private, public = make_keys(tmp_path / "new" / "keys")
    assert (private.name, public.name) == ("signing.key", "signing.pub")
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert stat.S_IMODE(public.stat().st_mode) == 0o644
    assert stat.S_IMODE(private.parent.stat().st_mode) == 0o700
    assert private.read_bytes().startswith(b"-----BEGIN PRIVATE KEY-----")
    verify(DATA, sign(DATA, load_private_key(private)), load_public_key(public))
    assert [p.name for p in sorted(private.parent.iterdir())] == ["signing.key", "signing.pub"]


def test_keys_are_never_overwritten(tmp_path: Path) -> None:
    private, public = make_keys(tmp_path)
    before = private.read_bytes(), public.read_bytes()
    with pytest.raises(
        BundleError, match=r"signing.key must not exist yet, but it does and keys are never overwritten"
    ):
        make_keys(tmp_path)
    assert (private.read_bytes(), public.read_bytes()) == before


def test_a_file_that_appears_meanwhile_is_left_as_it_is(tmp_path: Path) -> None:
    # The other process wrote its key between this one's look and its own writing.
    (tmp_path / "signing.key").write_text("theirs")
    assert not _create(tmp_path / "signing.key", b"mine", 0o600)
    assert (tmp_path / "signing.key").read_text() == "theirs"
    assert [p.name for p in tmp_path.iterdir()] == ["signing.key"]


def test_a_lost_public_key_comes_back_and_a_lost_private_one_does_not(tmp_path: Path) -> None:
    private, public = make_keys(tmp_path)
    before = public.read_bytes()
    public.unlink()
    make_keys(tmp_path)
    assert public.read_bytes() == before
    private.unlink()
    with pytest.raises(BundleError, match=r"signing.pub stands without its signing.key"):
        make_keys(tmp_path)
    assert public.read_bytes() == before


def test_of_two_processes_that_make_keys_at_once_one_wins_and_the_pair_is_one(tmp_path: Path) -> None:
    program = f"""
import sys, time
from pathlib import Path
from attentionvote.inference.bundles.signature import make_keys
sys.stdin.readline()
make_keys(Path({str(tmp_path)!r}))
"""
    many = [
        subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    for process in many:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    for process in many:
        process.communicate(timeout=60)
    key = load_private_key(tmp_path / "signing.key")
    assert fingerprint(key.public_key()) == fingerprint(load_public_key(tmp_path / "signing.pub"))
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["signing.key", "signing.pub"]


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BundleError, match="must be a folder that can be written"):
        make_keys(tmp_path / "file")


def test_keys_folder_is_the_environments_or_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(tmp_path))
    assert keys_folder() == tmp_path
    monkeypatch.delenv("ATTENTIONVOTE_KEYS")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert keys_folder() == tmp_path / ".config" / "attentionvote"


def test_a_private_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    private, _ = make_keys(tmp_path)
    private.chmod(0o640)
    with pytest.raises(BundleError, match=r"signing.key must be readable by its owner only \(mode 600\), got mode 640"):
        load_private_key(private)


def test_files_that_are_no_keys_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    with pytest.raises(BundleError, match=r"must be a public key, but it cannot be read \(No such file"):
        load_public_key(path)
    for content in (b"", b"hello", b"\x00" * 100, b"-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n"):
        path.write_bytes(content)
        path.chmod(0o600)
        with pytest.raises(BundleError, match="must be an unencrypted public key in PEM form"):
            load_public_key(path)
        with pytest.raises(BundleError, match="must be an unencrypted private key in PEM form"):
            load_private_key(path)
    path.write_bytes(b"x" * 20_000)
    with pytest.raises(BundleError, match="of at most 16384 bytes"):
        load_public_key(path)


def test_keys_of_another_kind_are_refused(tmp_path: Path) -> None:
    other = ec.generate_private_key(ec.SECP256R1())
    pem, public = serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    (tmp_path / "pub").write_bytes(other.public_key().public_bytes(pem, public))
    with pytest.raises(BundleError, match="must be an Ed25519 public key, got EC"):
        load_public_key(tmp_path / "pub")
    kind, none = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    (tmp_path / "key").write_bytes(other.private_bytes(pem, kind, none))
    (tmp_path / "key").chmod(0o600)
    with pytest.raises(BundleError, match="must be an Ed25519 private key, got EC"):
        load_private_key(tmp_path / "key")
    locked = KEY.private_bytes(pem, kind, serialization.BestAvailableEncryption(b"secret"))
    (tmp_path / "key").write_bytes(locked)
    with pytest.raises(BundleError, match="must be an unencrypted private key"):
        load_private_key(tmp_path / "key")


def test_a_fingerprint_is_of_the_raw_public_key() -> None:
    raw = KEY.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    assert fingerprint(KEY.public_key()) == hashlib.sha256(raw).hexdigest()[:16]
    assert json.loads(sign(DATA, KEY))["key"] == fingerprint(KEY.public_key())
    assert json.loads(sign(DATA, KEY))["algorithm"] == "ed25519"


def test_another_key_is_refused_and_both_are_named() -> None:
    mine, theirs = fingerprint(KEY.public_key()), fingerprint(OTHER.public_key())
    with pytest.raises(BundleError, match=f"trusted key {mine}, but it is signed by key {theirs}"):
        verify(DATA, sign(DATA, OTHER), KEY.public_key())


def test_a_signature_under_the_trusted_keys_name_by_another_key_is_refused() -> None:
    forged = json.loads(sign(DATA, OTHER)) | {"key": fingerprint(KEY.public_key())}
    with pytest.raises(BundleError, match="does not fit the manifest"):
        verify(DATA, json.dumps(forged).encode(), KEY.public_key())


@given(place=st.integers(0, len(DATA) - 1), flip=st.integers(1, 255))
def test_no_changed_byte_passes(place: int, flip: int) -> None:
    changed = bytearray(DATA)
    changed[place] ^= flip
    with pytest.raises(BundleError, match="changed after it was signed"):
        verify(bytes(changed), sign(DATA, KEY), KEY.public_key())


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"[]",
        b"null",
        b"\xff\xfe",
        b'{"algorithm":"ed25519","key":1,"signature":"AAAA"}',
        b'{"algorithm":"ed25519","key":"a","signature":"not base64!"}',
        b'{"algorithm":"ed25519","key":"a","signature":"AAAA","more":1}',
        b"[" * 10_000,
        b" " * 100_000,
    ],
)
def test_a_malformed_signature_file_is_one_sentence(content: bytes) -> None:
    with pytest.raises(BundleError, match="the signature file must be JSON"):
        verify(DATA, content, KEY.public_key())


def test_another_algorithm_is_refused() -> None:
    other = json.loads(sign(DATA, KEY)) | {"algorithm": "none"}
    with pytest.raises(BundleError, match="algorithm must be ed25519, got 'none'"):
        verify(DATA, json.dumps(other).encode(), KEY.public_key())


@given(st.binary(max_size=300))
def test_no_bytes_pass_as_a_signature_or_raise_anything_else(content: bytes) -> None:
    with pytest.raises(BundleError):
        verify(DATA, content, KEY.public_key())
