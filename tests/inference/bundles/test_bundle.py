"""A bundle loads when it is whole and signed; every way of being broken is one sentence that names the file."""

from __future__ import annotations

import hashlib
import io
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attentionvote.contract import VERSION, ModelCard
from attentionvote.inference.bundles.bundle import load_bundle
from attentionvote.inference.bundles.manifest import BESIDE, write_manifest
from attentionvote.inference.bundles.signature import load_private_key, load_public_key, make_keys
from attentionvote.inference.errors import BundleError

MakeBundle = Callable[..., Path]


def test_a_whole_bundle_is_loaded(bundle_folder: Path, trusted_key: Path, make_card: Callable[..., ModelCard]) -> None:
    bundle = load_bundle(bundle_folder, trusted_key)
    assert bundle.card == make_card()
    assert bundle.card.evaluation == {"ap": 0.9}
    assert bundle.digest == hashlib.sha256((bundle_folder / "manifest.json").read_bytes()).hexdigest()
    assert bundle.model == (bundle_folder / "model.onnx").read_bytes()
    assert [cloud.name for cloud in bundle.golden()] == ["cloud_0"]
    assert len(repr(bundle)) < 2000
    for trusted in (load_public_key(trusted_key), str(trusted_key), None):
        assert load_bundle(str(bundle_folder), trusted).digest == bundle.digest


def test_the_folder_may_be_a_link(bundle_folder: Path, trusted_key: Path, tmp_path: Path) -> None:
    (tmp_path / "current").symlink_to(bundle_folder.name)
    assert load_bundle(tmp_path / "current", trusted_key).digest == load_bundle(bundle_folder, trusted_key).digest


def test_what_was_verified_stays_when_the_folder_goes(bundle_folder: Path, trusted_key: Path) -> None:
    bundle = load_bundle(bundle_folder, trusted_key)
    shutil.rmtree(bundle_folder)
    assert len(bundle.golden()[0].points) == 3000


def test_a_missing_folder_or_a_file_instead(tmp_path: Path, trusted_key: Path) -> None:
    with pytest.raises(BundleError, match=r"must be a bundle's folder, but it cannot be opened \(No such file"):
        load_bundle(tmp_path / "none", trusted_key)
    (tmp_path / "file").write_text("")
    with pytest.raises(BundleError, match="must be a bundle's folder, got a file: name the folder it lies in"):
        load_bundle(tmp_path / "file", trusted_key)
    with pytest.raises(BundleError, match=r"manifest.json is missing: copy or export the bundle again"):
        load_bundle(tmp_path, trusted_key)
    with pytest.raises(BundleError, match="cannot be opened"):
        load_bundle("a\0b", trusted_key)


def test_a_missing_key_is_one_sentence(bundle_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(
        BundleError, match=r"none\.pub must be a public key, but it cannot be read .*: copy signing\.pub"
    ):
        load_bundle(bundle_folder, tmp_path / "none.pub")


@pytest.mark.parametrize(
    "name", ["model.onnx", "card.json", "part.ply", "golden/cloud_0.npz", "manifest.json", "manifest.sig"]
)
def test_every_file_is_needed(bundle_folder: Path, trusted_key: Path, name: str) -> None:
    (bundle_folder / name).unlink()
    with pytest.raises(BundleError, match=f"{bundle_folder}: {name} is missing"):
        load_bundle(bundle_folder, trusted_key)


@pytest.mark.parametrize("name", ["model.onnx", "card.json", "part.ply", "golden/cloud_0.npz"])
def test_a_truncated_file_is_named(bundle_folder: Path, trusted_key: Path, name: str) -> None:
    path = bundle_folder / name
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(BundleError, match=f"{name} must have {len(content)} bytes, got {len(content) - 1}"):
        load_bundle(bundle_folder, trusted_key)


@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", ["model.onnx", "card.json", "part.ply", "golden/cloud_0.npz"])
@pytest.mark.parametrize("signature", [True, False])
def test_a_flipped_bit_is_named(
    bundle_folder: Path, trusted_key: Path, name: str, place: float, signature: bool
) -> None:
    path = bundle_folder / name
    content = bytearray(path.read_bytes())
    content[int(place * (len(content) - 1))] ^= 1
    path.write_bytes(content)
    with pytest.raises(
        BundleError, match=rf"{name} must have the sha256 [0-9a-f]{{12}}..., but its content was changed"
    ):
        load_bundle(bundle_folder, trusted_key if signature else None)


def test_no_bit_of_manifest_or_signature_can_be_flipped(bundle_folder: Path, trusted_key: Path) -> None:
    key = load_public_key(trusted_key)
    for name in ("manifest.json", "manifest.sig"):
        content = (bundle_folder / name).read_bytes()
        for place in range(0, len(content), 7):
            changed = bytearray(content)
            changed[place] ^= 1
            (bundle_folder / name).write_bytes(changed)
            with pytest.raises(BundleError, match=f"^{bundle_folder}: "):
                load_bundle(bundle_folder, key)
        (bundle_folder / name).write_bytes(content)
    load_bundle(bundle_folder, key)


@pytest.mark.parametrize("name", ["extra.txt", "golden/extra.npz", ".hidden", "new/file"])
def test_an_unlisted_file_is_named(bundle_folder: Path, trusted_key: Path, name: str) -> None:
    path = bundle_folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("x")
    with pytest.raises(BundleError, match=rf"{name} is not in manifest.json: remove it, or export the bundle again"):
        load_bundle(bundle_folder, trusted_key)


def test_what_mlflow_keeps_beside_the_files_is_passed_over_by_its_names_alone(
    bundle_folder: Path, trusted_key: Path, signing_keys: tuple[Path, Path]
) -> None:
    digest = load_bundle(bundle_folder, trusted_key).digest
    for name in BESIDE:
        (bundle_folder / name).write_text("not read")
    assert load_bundle(bundle_folder, trusted_key).digest == digest
    write_manifest(bundle_folder, load_private_key(signing_keys[0]))
    assert load_bundle(bundle_folder, trusted_key).digest == digest
    (bundle_folder / "golden" / "MLmodel").write_text("x")
    with pytest.raises(BundleError, match=r"golden/MLmodel is not in manifest\.json"):
        load_bundle(bundle_folder, trusted_key)


def test_links_inside_are_refused_even_to_the_right_content(
    bundle_folder: Path, trusted_key: Path, tmp_path: Path
) -> None:
    shutil.copy(bundle_folder / "model.onnx", tmp_path / "model.onnx")
    (bundle_folder / "model.onnx").unlink()
    (bundle_folder / "model.onnx").symlink_to(tmp_path / "model.onnx")
    with pytest.raises(BundleError, match=r"model.onnx must be a plain file, got a symbolic link"):
        load_bundle(bundle_folder, trusted_key)


def test_another_key_is_refused_unless_nobody_asks(bundle_folder: Path, tmp_path: Path) -> None:
    _, public = make_keys(tmp_path / "others")
    with pytest.raises(BundleError, match=r"must be signed by the trusted key .*, but it is signed by key"):
        load_bundle(bundle_folder, public)
    load_bundle(bundle_folder, None)


def test_signing_again_with_another_key_does_not_help(bundle_folder: Path, trusted_key: Path, tmp_path: Path) -> None:
    private, _ = make_keys(tmp_path / "others")
    (bundle_folder / "part.ply").write_bytes(b"ply, but another one")
    write_manifest(bundle_folder, load_private_key(private))
    with pytest.raises(BundleError, match="must be signed by the trusted key"):
        load_bundle(bundle_folder, trusted_key)


def test_a_card_of_another_contract_is_refused(make_bundle: MakeBundle, trusted_key: Path) -> None:
    def change(folder: Path) -> None:
        text = (folder / "card.json").read_text()
        (folder / "card.json").write_text(text.replace(f'"contract_version": {VERSION}', '"contract_version": 99'))

    with pytest.raises(BundleError, match=r"card\.json: .* contract_version 1, got 99: export the model again"):
        load_bundle(make_bundle(change=change), trusted_key)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe"])
def test_a_card_that_is_none(make_bundle: MakeBundle, trusted_key: Path, content: bytes) -> None:
    with pytest.raises(BundleError, match=r"card\.json: "):
        load_bundle(make_bundle(change=lambda folder: (folder / "card.json").write_bytes(content)), trusted_key)


def test_a_card_of_another_export_is_refused(make_bundle: MakeBundle, trusted_key: Path, other_card: ModelCard) -> None:
    def change(folder: Path) -> None:
        (folder / "card.json").write_text(other_card.to_json())

    with pytest.raises(BundleError, match=r"card.json must be the card that model.onnx carries, but they differ"):
        load_bundle(make_bundle(change=change), trusted_key)


def test_figures_measured_on_the_graph_are_only_in_the_card(
    make_bundle: MakeBundle, trusted_key: Path, make_card: Callable[..., ModelCard]
) -> None:
    def change(folder: Path) -> None:
        (folder / "card.json").write_text(replace(make_card(), evaluation={"ap": 0.1}).to_json())

    assert load_bundle(make_bundle(change=change), trusted_key).card.evaluation == {"ap": 0.1}


def test_a_graph_without_card_and_a_file_that_is_no_graph(make_bundle: MakeBundle, trusted_key: Path) -> None:
    with pytest.raises(BundleError, match=r"model.onnx must carry its card, but it carries none"):
        load_bundle(make_bundle("bare", graph={"metadata": False}), trusted_key)
    junk = make_bundle("junk", change=lambda folder: (folder / "model.onnx").write_bytes(b"\xff" * 50))
    with pytest.raises(BundleError, match=r"model.onnx must be an ONNX file, but a number has more than ten bytes"):
        load_bundle(junk, trusted_key)


@pytest.mark.parametrize("symmetry", [{"kind": "cubic"}, {"kind": "cyclic", "order": 1}, {"sort": "none"}])
def test_an_impossible_symmetry_is_refused(
    make_bundle: MakeBundle, trusted_key: Path, symmetry: dict[str, Any]
) -> None:
    with pytest.raises(BundleError, match=r"card\.json: .*(symmetry|unexpected keyword argument 'sort')"):
        load_bundle(make_bundle(card={"part": {"symmetry": symmetry}}), trusted_key)


def golden(**arrays: Any) -> Callable[[Path], None]:
    """A change of a bundle: its golden cloud holds these arrays."""

    def change(folder: Path) -> None:
        stream = io.BytesIO()
        whole = {
            "points": np.zeros((5, 3), np.float32),
            "camera_from_part": np.zeros((1, 4, 4)),
            "confidence": np.ones(1, np.float32),
        }
        np.savez(stream, **{name: array for name, array in (whole | arrays).items() if array is not None})
        (folder / "golden" / "cloud_0.npz").write_bytes(stream.getvalue())

    return change


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": None}, "must be a golden cloud, but 'points'"),
        ({"points": np.zeros((5, 3))}, r"must hold points \(P, 3\) float32"),
        ({"points": np.zeros((5, 4), np.float32)}, "must hold points"),
        ({"camera_from_part": np.zeros((2, 4, 4))}, "must hold points"),
        ({"camera_from_part": np.float64(3)}, "must hold points"),
        ({"confidence": np.ones((1, 1), np.float32)}, "must hold points"),
        ({"points": np.array([{}])}, "must be a golden cloud, but its .npy header does not describe"),
    ],
)
def test_a_golden_cloud_that_is_none(
    make_bundle: MakeBundle, trusted_key: Path, arrays: dict[str, Any], message: str
) -> None:
    bundle = load_bundle(make_bundle(change=golden(**arrays)), trusted_key)
    with pytest.raises(BundleError, match=rf"golden/cloud_0.npz {message}"):
        bundle.golden()
