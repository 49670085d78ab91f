"""A bundle on disk: complete, signed, tested, reproducible, and never half there."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray
from real_disks import resize, small_disk

from attentionvote.contract import ModelCard
from attentionvote.export import bundle_writer
from attentionvote.export.bundle_writer import write_bundle
from attentionvote.export.triton_layout import write_triton
from attentionvote.files import DiskFull
from attentionvote.inference import PoseEstimator, load_bundle
from attentionvote.part import Part

pytestmark = pytest.mark.slow
Cloud = tuple[NDArray[np.float32], NDArray[np.float32]]
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


@pytest.fixture
def write(graph: bytes, card: ModelCard, part: Part, make_cloud: Callable[..., Cloud], tmp_path: Path) -> Callable:
    def run(golden: int = 2, **changes: object) -> object:
        clouds = ((f"scene_{seed}", make_cloud(seed, 1500)[0]) for seed in (1, 2, 3))
        return write_bundle(graph, replace(card, **changes), part, clouds, golden, KEY, tmp_path / "brick")

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


def test_a_full_disk_is_named_and_nothing_half_written_stays(write: Callable, tmp_path: Path) -> None:
    with small_disk(tmp_path / "brick", "100k") as disk:
        with pytest.raises(DiskFull, match=rf"^the disk of {disk} must have room"):
            write()
        assert not list(disk.iterdir())
        resize(disk, "100m")
        bundle = write()
        assert (disk / "latest").resolve() == bundle.path


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


def test_only_clouds_with_a_clear_pose_are_golden(
    write: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match=r"a golden cloud must show a pose with confidence of at least 1, but .*"):
        write(confidence_threshold=0.9999)
    assert list((tmp_path / "brick").iterdir()) == []
    best = {cloud.name: float(cloud.confidence.max()) for cloud in write(golden=3).golden()}
    assert len(best) == 3
    weakest, strongest = min(best, key=best.__getitem__), max(best, key=best.__getitem__)
    between = (best[weakest] + best[strongest]) / 2
    monkeypatch.setattr(bundle_writer, "clear_confidence", lambda _: between)
    names = [cloud.name for cloud in write(golden=3).golden()]
    assert strongest in names
    assert weakest not in names


def test_a_damaged_copy_is_replaced_and_a_whole_one_left_alone(write: Callable, tmp_path: Path) -> None:
    bundle = write()
    inode = (bundle.path / "model.onnx").stat().st_ino
    assert (write().path / "model.onnx").stat().st_ino == inode
    with (bundle.path / "model.onnx").open("r+b") as file:
        file.seek(1000)
        file.write(b"x")
    (tmp_path / "brick" / "latest").unlink()
    again = write()
    assert again.digest == bundle.digest
    assert load_bundle(tmp_path / "brick" / "latest", KEY.public_key()).digest == bundle.digest
    assert sorted(p.name for p in (tmp_path / "brick").iterdir()) == sorted([bundle.digest[:12], "latest"])


KILLED = """
import os, pathlib, shutil, signal, sys
sys.path.insert(0, sys.argv[1])
from bundle_of_test import write
left = int(sys.argv[2])
def counting(function):
    def counted(*a, **k):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*a, **k)
    return counted
for owner, name in ((pathlib.Path, "rename"), (pathlib.Path, "replace"), (os, "fsync"), (shutil, "rmtree")):
    setattr(owner, name, counting(getattr(owner, name)))
write()
"""
WRITE = """
import pathlib
import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from attentionvote.contract import ModelCard
from attentionvote.export.bundle_writer import write_bundle
from attentionvote.simulation.part_files import load_part
here = pathlib.Path(__file__).parent
def write():
    card = ModelCard.from_json((here / "card.json").read_text())
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    part = load_part("brick", "builtin:brick")
    clouds = [("scene_1", np.load(here / "cloud.npy"))]
    return write_bundle((here / "model.onnx").read_bytes(), card, part, clouds, 1, key, here / "brick")
"""


@pytest.mark.parametrize("step", [1, 8, 14, 17])
def test_killed_anywhere_what_served_stays_and_the_next_export_ends_well(
    graph: bytes, card: ModelCard, write: Callable, make_cloud: Callable[..., Cloud], tmp_path: Path, step: int
) -> None:
    before = write()
    changed = replace(card, evaluation={"ap_10": 0.75})
    (tmp_path / "model.onnx").write_bytes(graph)
    (tmp_path / "card.json").write_text(changed.to_json(), encoding="utf-8")
    np.save(tmp_path / "cloud.npy", make_cloud(1, 1500)[0])
    (tmp_path / "bundle_of_test.py").write_text(WRITE, encoding="utf-8")
    command = [sys.executable, "-c", KILLED, str(tmp_path), str(step)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    folder = tmp_path / "brick"
    assert load_bundle(folder / "latest", KEY.public_key()).card in (before.card, changed)
    after = write(golden=1, evaluation={"ap_10": 0.75})
    assert load_bundle(folder / "latest", KEY.public_key()).digest == after.digest
    assert sorted(p.name for p in folder.iterdir()) == sorted([before.digest[:12], after.digest[:12], "latest"])


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
