"""The verb export: from a training's folder to a signed bundle, once; only a report where the proof fails."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import export
import pytest
import torch
from tiny_network import EXPORT_CHANGES, TINY_ARGUMENTS

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.files import FolderUnavailable
from attentionvote.inference import load_bundle
from attentionvote.model.network import AttentionVote
from attentionvote.training.checkpoint import load_trained, save_trained
from attentionvote.workflows.settings import ExportSettings

ROOT = Path(__file__).resolve().parents[2]
SCENES = [
    "object=brick",
    "simulation=smoke",
    "simulation.cycles={train:1,val:1,test:2}",
    "simulation.drop_counts=[2,4]",
]
EXPORT = ["object=brick", "limits.scenes=2", "scenes=4", "golden=2", "workers=1"]


def python(script: str, *words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A pipeline in a process of its own, with keys in ``folder``."""
    environment = os.environ | {"ATTENTIONVOTE_KEYS": str(folder / "keys")}
    command = [sys.executable, str(ROOT / "pipelines" / script), *words]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280, check=False
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes of bricks and a training of a small network that votes near its seeds."""
    from dataclasses import asdict

    from attentionvote.simulation.part_files import load_part
    from attentionvote.simulation.scene_set import SceneSet

    folder = tmp_path_factory.mktemp("trained")
    done = python("generate.py", *SCENES, "splits=[test]", "workers=1", folder=folder)
    assert done.returncode == 0, done.stderr
    part = load_part("brick", "builtin:brick")
    box = [part.vertices.min(0).tolist(), part.vertices.max(0).tolist()]
    network = TINY_ARGUMENTS | EXPORT_CHANGES | {"diameter": float(part.diameter), "box": box, "refinement_steps": 1}
    torch.manual_seed(0)
    scenes = SceneSet.open(next((folder / "data" / "scenes" / "brick").glob("test-*")))
    metadata = {
        "format": 1, "version": "0.1.0", "model": network,
        "part": {
            "name": "brick", "title": part.title, "diameter": float(part.diameter), "digest": part.digest,
            "symmetry": json.loads(json.dumps(asdict(part.symmetry))),
        },
        "points": 400,
        "clouds": {"sensor": {"preset": "gaussian", "sigma_mm": 0.1}, "density": 2000, "pool": 1000, "neighbors": 12},
        "peak_threshold": 0.05, "confidence_threshold": 0.1, "data": {"test": scenes.digest}, "test": {"ap_10": 0.1},
    }  # fmt: skip
    training = folder / "outputs" / "train" / "brick" / "0123456789ab"
    save_trained(AttentionVote.from_arguments(network).eval(), metadata, training / "model.ckpt")
    (training / "result.json").write_text(json.dumps({"run_id": "feed" * 8, "commit": "c" * 40}), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def exported(trained: Path) -> dict[str, Any]:
    done = python("export.py", *EXPORT, "triton=triton", folder=trained)
    assert done.returncode == 0, done.stderr
    assert "matched poses" in done.stderr
    assert len(done.stdout.splitlines()) == 1
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@pytest.mark.slow
def test_a_training_becomes_a_bundle_that_a_cell_trusts(trained: Path, exported: dict[str, Any]) -> None:
    latest = trained / "outputs" / "export" / "brick" / "latest"
    bundle = load_bundle(latest, trained / "keys" / "signing.pub")
    assert latest.resolve() == (trained / exported["bundle"]).resolve()
    assert bundle.digest == exported["digest"]
    card = bundle.card
    assert (card.run_id, card.commit, card.evaluation) == ("feed" * 8, "c" * 40, {"ap_10": 0.1})
    assert card.parity == {"limits": exported["limits"], "paths": exported["parity"]}
    assert exported["parity"]["CPU"]["scenes"] == 4
    assert exported["parity"]["CPU"]["pairs"] > 4
    assert len(bundle.golden()) == 2
    assert (trained / "triton" / "brick" / "1" / "model.onnx").read_bytes() == bundle.model
    assert exported["milliseconds"]["CPU"] > 0


@pytest.fixture
def again(trained: Path, exported: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """The verb in this process, where the training was; tracing again is an error."""
    import attentionvote.export.onnx_file

    def never(*_: object) -> bytes:
        raise AssertionError("traced again")

    monkeypatch.chdir(trained)
    monkeypatch.setattr(attentionvote.export.onnx_file, "export_graph", never)
    words = [*EXPORT, f"signing_keys={trained}/keys"]
    assert exported["stage"] == "export"
    return lambda *more: export.run(compose(ExportSettings, [*words, *more]))


@pytest.mark.slow
def test_what_is_done_is_not_done_again(again: Callable, exported: dict[str, Any]) -> None:
    assert again("triton=triton") == exported


@pytest.mark.slow
def test_a_done_export_points_latest_at_its_bundle_and_writes_triton(again: Callable, trained: Path) -> None:
    latest = trained / "outputs" / "export" / "brick" / "latest"
    place = latest.resolve()
    latest.unlink()
    shutil.rmtree(trained / "triton")
    again("triton=triton")
    assert latest.resolve() == place
    assert (trained / "triton" / "brick" / "config.pbtxt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["model", "record", "settings", "force"])
def test_what_is_not_done_any_more_is_done_again(again: Callable, trained: Path, damage: str) -> None:
    folder = trained / "outputs" / "export" / "brick"
    record = next(folder.glob("export-*.json"))
    model, text = folder / "latest" / "model.onnx", record.read_bytes()
    content, words = model.read_bytes(), []
    if damage == "model":
        model.write_bytes(content[:-1] + b"x")
    elif damage == "record":
        record.write_bytes(b"[1")
    else:
        words = {"settings": ["golden=1"], "force": ["force=true"]}[damage]
    try:
        with pytest.raises(AssertionError, match="traced again"):
            again(*words)
    finally:
        model.write_bytes(content)
        record.write_bytes(text)
    again()


@pytest.mark.slow
def test_changed_parts_and_lost_scenes_are_refused_before_any_work(again: Callable, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="brick must be the part the network was trained for"):
        again("object.diameter=0.05")
    with pytest.raises(ConfigurationError, match=r"the test scenes .* of the training must lie below"):
        again("force=true", f"root={tmp_path}")
    with pytest.raises(ConfigurationError, match=r"at least limits.scenes \(5\) held-out scenes .* got 4"):
        again("scenes=5", "limits.scenes=5")


@pytest.mark.slow
def test_over_the_limits_only_the_report_is_written(
    trained: Path, exported: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graph of one network cannot pass for another: the checkpoint is changed after its export."""
    import attentionvote.export.onnx_file

    stored = load_bundle(trained / exported["bundle"], None).model
    training = tmp_path / "train" / "brick" / "abcdefabcdef"
    model, metadata = load_trained(trained / "outputs/train/brick/0123456789ab/model.ckpt")
    with torch.no_grad():
        model.output.bias[:3] += 0.5
        for refiner in model.refiners:
            refiner.output.bias[:3] += 0.2  # type: ignore[index, union-attr]
    save_trained(model, metadata, training / "model.ckpt")
    (training / "result.json").write_text(json.dumps({"run_id": "f00d", "commit": ""}), encoding="utf-8")
    monkeypatch.setattr(attentionvote.export.onnx_file, "export_graph", lambda *_: stored)
    words = [f"root={trained}/data", f"trained={tmp_path}/train", f"outputs={tmp_path}/export"]
    cfg = compose(ExportSettings, [*EXPORT, *words, f"signing_keys={trained}/keys"])
    with pytest.raises(ValueError, match=r"must be equal within the limits, but CPU: .*the report is"):
        export.run(cfg)
    written = [p.relative_to(tmp_path / "export").as_posix() for p in (tmp_path / "export").rglob("*") if p.is_file()]
    assert sorted(written) == ["brick/.lock", "brick/parity-abcdefabcdef.json"]
    report = json.loads((tmp_path / "export" / "brick" / "parity-abcdefabcdef.json").read_text(encoding="utf-8"))
    assert report["parity"]["CPU"]["scenes"] == 4


@pytest.fixture
def two_trainings(tmp_path: Path) -> list[str]:
    for name, run_id in (("aaaa11112222", "cafe1"), ("aaaa33334444", "cafe2")):
        folder = tmp_path / "train" / "brick" / name
        folder.mkdir(parents=True)
        (folder / "model.ckpt").touch()
        (folder / "result.json").write_text(json.dumps({"run_id": run_id}), encoding="utf-8")
    return [*EXPORT, f"trained={tmp_path}/train", f"outputs={tmp_path}/export", f"signing_keys={tmp_path}/keys"]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("run=cafe", "run must name one complete training, 'cafe' names 2; there are aaaa11112222 (run cafe1), aaaa"),
        ("run=dead", "run must name one complete training, 'dead' names 0"),
        ("trained=nowhere", "nowhere/brick must hold a complete training, got none: run `make train OBJECT=brick`"),
        ("scenes=1", "scenes must be at least limits.scenes (2), got 1"),
    ],
)
def test_a_training_that_cannot_be_meant_is_one_sentence(two_trainings: list[str], word: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        export.run(compose(ExportSettings, [*two_trainings, word]))
    assert message in str(caught.value)


def test_the_newest_of_several_trainings_is_taken_and_the_others_are_named(
    two_trainings: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from attentionvote.workflows.export import ExportJob

    older = tmp_path / "train" / "brick" / "aaaa33334444" / "result.json"
    older.write_text(json.dumps({"run_id": "cafe2", "metrics": {"ap_10": 0.9, "ap_5": 0.8, "ap_2": 0.25}}))
    os.utime(older, (1, 1))
    with caplog.at_level("INFO", logger="attentionvote.export"):
        assert ExportJob.find(compose(ExportSettings, two_trainings)).training.name == "aaaa11112222"
    said = "the newest training is taken, aaaa11112222 (AP unknown); RUN=... takes aaaa33334444 (AP 0.900/0.800/0.250)"
    assert said in caplog.messages


def test_a_damaged_training_is_passed_over(two_trainings: list[str], tmp_path: Path) -> None:
    from attentionvote.workflows.export import ExportJob

    (tmp_path / "train" / "brick" / "aaaa11112222" / "result.json").write_text("", encoding="utf-8")
    assert ExportJob.find(compose(ExportSettings, two_trainings)).training.name == "aaaa33334444"


def test_one_process_exports_a_part(two_trainings: list[str]) -> None:
    from attentionvote.workflows.export import ExportJob

    job = ExportJob.find(compose(ExportSettings, two_trainings))
    refused = pytest.raises(FolderUnavailable, match="another process is at this part's export")
    with job.locked(), refused, job.locked():
        raise AssertionError("two at once")


def test_a_place_that_cannot_be_written_is_said_first(two_trainings: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FolderUnavailable, match=r"outputs=.*/file/x cannot be written: Not a directory"):
        export.run(compose(ExportSettings, [*two_trainings, f"outputs={tmp_path}/file/x"]))


def test_a_lost_public_key_comes_back(two_trainings: list[str], tmp_path: Path) -> None:
    from attentionvote.workflows.export import ExportJob

    ExportJob.find(compose(ExportSettings, two_trainings))
    public = tmp_path / "keys" / "signing.pub"
    text = public.read_bytes()
    public.unlink()
    ExportJob.find(compose(ExportSettings, two_trainings))
    assert public.read_bytes() == text


def test_a_run_is_named_by_the_beginning_of_its_id_or_folder(two_trainings: list[str]) -> None:
    from attentionvote.workflows.export import ExportJob

    find: Callable[[str], Path] = lambda word: ExportJob.find(compose(ExportSettings, [*two_trainings, word])).training  # noqa: E731
    assert find("run=cafe1").name == "aaaa11112222"
    assert find("run=aaaa3").name == "aaaa33334444"
