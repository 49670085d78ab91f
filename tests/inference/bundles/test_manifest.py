"""The manifest names every file, and a folder that differs from it in any way is refused."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from attentionvote.inference.bundles.manifest import canonical, opened, parse_manifest, read_file, write_manifest
from attentionvote.inference.errors import BundleError

ENTRY = {"bytes": 1, "sha256": "0" * 64}
FILES = dict.fromkeys(("model.onnx", "card.json", "part.ply", "golden/a.npz"), ENTRY)
KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))


def test_the_manifest_is_canonical_and_names_every_file(bundle_folder: Path) -> None:
    content = (bundle_folder / "manifest.json").read_bytes()
    fields = json.loads(content)
    assert content == json.dumps(fields, sort_keys=True, separators=(",", ":")).encode()
    assert fields["bundle"] == 1
    assert sorted(fields["files"]) == ["card.json", "golden/cloud_0.npz", "model.onnx", "part.ply"]
    for name, entry in fields["files"].items():
        data = (bundle_folder / name).read_bytes()
        assert entry == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert not list(bundle_folder.glob(".*"))


def test_writing_again_gives_the_same_bytes(bundle_folder: Path, signing_keys: tuple[Path, Path]) -> None:
    from attentionvote.inference.bundles.signature import load_private_key

    before = [(bundle_folder / name).read_bytes() for name in ("manifest.json", "manifest.sig")]
    write_manifest(bundle_folder, load_private_key(signing_keys[0]))
    assert [(bundle_folder / name).read_bytes() for name in ("manifest.json", "manifest.sig")] == before


@pytest.mark.parametrize("name", ["model.onnx", "card.json", "part.ply"])
def test_an_incomplete_folder_is_not_signed(make_bundle: Callable[..., Path], name: str) -> None:
    with pytest.raises(BundleError, match=f"a bundle must hold {name}, but there is none"):
        make_bundle(change=lambda folder: (folder / name).unlink())


def test_a_bundle_without_golden_clouds_is_not_signed(make_bundle: Callable[..., Path]) -> None:
    with pytest.raises(BundleError, match=r"at least one golden/NAME\.npz for the self-test, got none"):
        make_bundle(golden=0)


@pytest.mark.parametrize("name", [".hidden", "with blank", "umlaut-ä", "-dash"])
def test_names_that_are_not_plain_are_not_signed(make_bundle: Callable[..., Path], name: str) -> None:
    with pytest.raises(BundleError, match="plain relative names"):
        make_bundle(change=lambda folder: (folder / name).write_text("x"))


def test_links_and_pipes_are_not_signed(make_bundle: Callable[..., Path]) -> None:
    with pytest.raises(BundleError, match="extra must be a plain file, got a symbolic link"):
        make_bundle("link", change=lambda folder: (folder / "extra").symlink_to("/etc/hostname"))
    with pytest.raises(BundleError, match="extra must be a plain file, got a device or pipe"):
        make_bundle("pipe", change=lambda folder: os.mkfifo(folder / "extra"))
    with pytest.raises(BundleError, match="a/b/c lies too deep"):
        make_bundle("deep", change=lambda folder: (folder / "a/b/c/d").mkdir(parents=True))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([], "must be {"),
        ({"bundle": 1}, "must be {"),
        ({"bundle": 1, "files": []}, "must be {"),
        ({"bundle": 1, "files": FILES, "more": 1}, "must be {"),
        ({"bundle": 2, "files": FILES}, "must be of bundle format 1, got 2: export the bundle again"),
        ({"bundle": True, "files": FILES}, "must be of bundle format 1, got True"),
        ({"bundle": 1, "files": {}}, "must hold model.onnx"),
        ({"bundle": 1, "files": {f"f{i}": ENTRY for i in range(300)}}, "at most 256 files, got 300"),
        ({"bundle": 1, "files": FILES | {"../x": ENTRY}}, r"the name '\.\./x', but a bundle's files have plain"),
        ({"bundle": 1, "files": FILES | {"a/../x": ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"/etc/passwd": ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"a//b": ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"a/b/c/d": ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"a\nb": ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"x" * 300: ENTRY}}, "plain relative names"),
        ({"bundle": 1, "files": FILES | {"manifest.sig": ENTRY}}, "must not list manifest.sig"),
        ({"bundle": 1, "files": FILES | {"x": {"bytes": -1, "sha256": "0" * 64}}}, "must give bytes and sha256 of x"),
        ({"bundle": 1, "files": FILES | {"x": {"bytes": 1.5, "sha256": "0" * 64}}}, "must give bytes and sha256 of x"),
        ({"bundle": 1, "files": FILES | {"x": {"bytes": 1, "sha256": "0" * 63}}}, "must give bytes and sha256 of x"),
        ({"bundle": 1, "files": FILES | {"x": {"bytes": 1, "sha256": "G" * 64}}}, "must give bytes and sha256 of x"),
        ({"bundle": 1, "files": FILES | {"x": 1}}, "must give bytes and sha256 of x"),
        (
            {"bundle": 1, "files": FILES | {"model.onnx": ENTRY | {"bytes": 2**30}}},
            "at most 536870912 bytes, got 1073741824",
        ),
        ({"bundle": 1, "files": FILES | {f"x{i}": ENTRY | {"bytes": 2**26} for i in range(5)}}, "bytes together"),
    ],
)
def test_an_impossible_manifest_is_one_sentence(fields: object, message: str) -> None:
    with pytest.raises(BundleError, match=message):
        parse_manifest(canonical(fields))


def test_a_manifest_must_be_canonical() -> None:
    fields = {"bundle": 1, "files": FILES}
    assert sorted(parse_manifest(canonical(fields))) == sorted(FILES)
    with pytest.raises(BundleError, match="must be canonical JSON"):
        parse_manifest(json.dumps(fields).encode())
    twice = canonical(fields).replace(b'{"bundle":1', b'{"bundle":1,"bundle":1')
    with pytest.raises(BundleError, match="must be canonical JSON"):
        parse_manifest(twice)


@given(st.binary(max_size=100) | st.text(alphabet='{}[]",:0123456789bundlefs', max_size=60).map(str.encode))
def test_no_bytes_raise_anything_else(content: bytes) -> None:
    with pytest.raises(BundleError):
        parse_manifest(content)


def test_deep_json_is_refused() -> None:
    with pytest.raises(BundleError, match="must be JSON"):
        parse_manifest(b"[" * 500_000)


def test_a_file_is_read_without_following_links(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "file").write_bytes(b"content")
    (tmp_path / "folder").symlink_to("real")
    (tmp_path / "real" / "link").symlink_to("file")
    os.mkfifo(tmp_path / "real" / "pipe")
    with opened(tmp_path) as handle:
        assert read_file(handle, "real/file", 7, tmp_path) == b"content"
        with pytest.raises(BundleError, match="real/file must have at most 6 bytes"):
            read_file(handle, "real/file", 6, tmp_path)
        for name in ("folder/file", "real/link", "real/pipe", "real"):
            with pytest.raises(BundleError, match=f"{name} must be a plain"):
                read_file(handle, name, 100, tmp_path)
        with pytest.raises(BundleError, match="real/none is missing: copy or export the bundle again"):
            read_file(handle, "real/none", 100, tmp_path)


def test_no_handle_stays_open(bundle_folder: Path) -> None:
    def count() -> int:
        return len(os.listdir("/proc/self/fd"))

    before = count()
    (bundle_folder / "link").symlink_to("model.onnx")
    for _ in range(3):
        with pytest.raises(BundleError):
            write_manifest(bundle_folder, KEY)
        with pytest.raises(BundleError), opened(bundle_folder) as handle:
            read_file(handle, "golden/none", 1, bundle_folder)
    assert count() == before
