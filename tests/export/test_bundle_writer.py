"""A bundle on disk: complete, signed, tested, reproducible, and never half there."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray

from attentionvote.contract import ModelCard
from attentionvote.export import bundle_writer, write_bundle, write_triton
from attentionvote.inference import PoseEstimator, load_bundle
from attentionvote.part import Part

pytestmark = pytest.mark.slow
Cloud = tuple[NDArray[np.float32], NDArray[np.float32]]
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


@pytest.fixture
def write(graph: bytes, card: ModelCard, part: Part, make_cloud: Callable[..., Cloud], tmp_path: Path) -> Callable:
    clouds = {f"scene_{seed}": make_cloud(seed, 1500)[0] for seed in (1, 2)}

    def run(**changes: object) -> object:
        return write_bundle(graph, replace(card, **changes), part, clouds, KEY, tmp_path / "brick")

    return run


def test_a_cell_can_load_and_run_it(write: Callable, tmp_path: Path) -> None:
    bundle = write()
    folder = tmp_path / "brick"
    assert (folder / "latest").resolve() == bundle.path == folder / bundle.digest[:12]
    names = {p.relative_to(bundle.path).as_posix() for p in bundle.path.rglob("*") if p.is_file()}
    assert names == {
        "model.onnx", "card.json", "part.ply", "manifest.json", "manifest.sig", "golden/scene_1.npz",
        "golden/scene_2.npz",
    }  # fmt: skip
    loaded = load_bundle(folder / "latest", KEY.public_key())
    assert loaded.digest == bundle.digest
    with PoseEstimator(loaded) as estimator:
        for golden in loaded.golden():
            answer = estimator.estimate_parts_only(golden.points)
            poses = np.stack([d.camera_from_part for d in answer.detections])
            np.testing.assert_array_equal(poses, golden.camera_from_part)
    assert sorted(p.name for p in folder.iterdir()) == sorted([bundle.digest[:12], "latest"])


def test_the_same_content_has_the_same_name_and_another_card_another(write: Callable) -> None:
    first, again, other = write(), write(), write(evaluation={"ap_10": 0.9})
    assert first.digest == again.digest != other.digest
    assert load_bundle(first.path, KEY.public_key()).digest == first.digest


def test_no_private_key_lies_in_it(write: Callable) -> None:
    raw = KEY.private_bytes_raw()
    for path in write().path.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert raw not in content
            assert b"PRIVATE KEY" not in content


def test_a_bundle_that_fails_its_test_is_not_published(
    write: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = write()
    monkeypatch.setattr(bundle_writer, "self_test", lambda *_: ["golden cloud scene_1 lost a pose"])
    with pytest.raises(ValueError, match="must pass its own self-test, but golden cloud scene_1 lost a pose"):
        write(evaluation={"ap_10": 0.1})
    folder = tmp_path / "brick"
    assert (folder / "latest").resolve() == before.path
    assert sorted(p.name for p in folder.iterdir()) == sorted([before.digest[:12], "latest"])


def test_a_cloud_without_poses_is_no_golden_cloud(write: Callable, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="golden cloud scene_1 must show poses, but the model finds none"):
        write(confidence_threshold=0.9999)
    assert list((tmp_path / "brick").iterdir()) == []


def test_what_a_killed_export_left_is_swept_away_and_a_running_ones_is_not(write: Callable, tmp_path: Path) -> None:
    dead, alive = (
        tmp_path / "brick" / ".writing-bundle.999999999",
        tmp_path / "brick" / f".writing-bundle.{os.getppid()}",
    )
    for folder in (dead, alive):
        folder.mkdir(parents=True)
    write()
    assert not dead.exists()
    assert alive.exists()


def test_a_triton_repository_names_every_tensor(write: Callable, tmp_path: Path, card: ModelCard) -> None:
    bundle = write()
    folder = write_triton(bundle, tmp_path / "triton", version=3)
    assert (folder / "3" / "model.onnx").read_bytes() == bundle.model
    text = (folder / "config.pbtxt").read_text(encoding="utf-8")
    for spec in (*card.inputs, *card.outputs):
        dims = ", ".join(map(str, spec.shape))
        assert f'name: "{spec.name}", data_type: TYPE_FP32, dims: [ {dims} ]' in text
    assert 'backend: "onnxruntime"\nmax_batch_size: 0' in text
    assert "versions: [ 3 ]" in text
    assert text.count("{") == text.count("}")
