"""The verb train: refusals before any work, a small training from end to end, interruptions of every kind."""

from __future__ import annotations

import errno
import importlib
import json
import logging
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import train
import warm_starter
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.drawing import figures, scene_pictures
from attentionvote.tracking.run_opening import start_run
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[3]
TINY = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2]", "workers=1", "trainer.max_epochs=6",
    "trainer.validate_every=2", "trainer.average_decay=0.5", "force=false",
]  # fmt: skip


CURVES = ("loss/vote", "learning_rate", "gradient_norm")
CHEAP = pytest.mark.usefixtures("cheap_figures")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene sets and clouds, made by the first training."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def words(root: Path, store: str, tmp_path: Path) -> list[str]:
    return [*TINY, f"root={root}", f"outputs={tmp_path / 'out'}", f"tracking.store={store}"]


@pytest.fixture
def cheap_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figure is drawn: each takes a second."""
    for module, names in (
        (scene_pictures, ["scene_picture"]),
        (figures, ["loss_figure", "precision_recall_figure", "ap_threshold_figure"]),
    ):
        for name in names:
            monkeypatch.setattr(module, name, lambda *_, **__: b"picture")


@pytest.fixture(autouse=True)
def alone() -> Iterator[None]:
    threads, level = torch.get_num_threads(), logging.getLogger("lightning.pytorch").level
    yield
    torch.set_num_threads(threads)
    logging.getLogger("lightning.pytorch").setLevel(level)


def run(words: list[str], *more: str) -> dict[str, Any]:
    return json.loads(json.dumps(train.run(compose(TrainSettings, [*words, *more]))))


@pytest.fixture
def verb() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts ``make train``'s script; what still runs when the test ends is killed."""
    with ExitStack() as stack:

        def start(words: list[str], warm: bool = False, **settings: Any) -> subprocess.Popen[str]:
            process = stack.enter_context(
                (warm_starter.Popen if warm else subprocess.Popen)(
                    [sys.executable, "pipelines/train.py", *words],
                    cwd=ROOT,
                    text=True,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    **settings,
                )
            )
            stack.callback(process.kill)
            return process

        yield start


Verb = Callable[..., subprocess.Popen[str]]


def weights(result: dict[str, Any]) -> dict[str, torch.Tensor]:
    return torch.load(result["model"], weights_only=True)["state_dict"]


def job_folder(tmp_path: Path) -> Path:
    (folder,) = (tmp_path / "out" / "brick").iterdir()
    return folder


def leftovers(folder: Path) -> list[str]:
    return [p.name for p in folder.rglob(".*") if p.name != ".lock"]


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (["object=bric"], "object must be one of .*; got 'bric', did you mean 'brick'?"),
        (["object=brick", "trainer.max_epoch=3"], "no setting 'trainer.max_epoch', did you mean 'trainer.max_epochs'?"),
        (["object=brick", "trainer.learning_rate=abc"], "trainer.learning_rate must be .* number .*; got 'abc'"),
        (["object=brick", "trainer.batch_size=-4"], "trainer.batch_size must be at least 1 and at most 100000; got -4"),
        (
            ["object=brick", "experiment=smoke", "trainer.batch_size=13"],
            "trainer.batch_size must be at most the 12 training scenes, got 13",
        ),
        (["object=bunny", "object.mesh=nowhere/bunny.obj"], "object bunny: mesh .* 'nowhere/bunny.obj'"),
        (["object=brick", "data.points=100"], r"data.points must be at least model.centers\[0\] \(512\), got 100"),
        (
            ["object=gear", "loss.settings.isotropic=0.3"],
            "object gear: loss.settings.isotropic must be left at 0.1 or be 0 for gear, a body of revolution",
        ),
        (["object=brick", "tracking.store=http//x"], "tracking store must be .*'http//x'"),
        (["object=brick", "outputs=/proc/self/environ/x"], "outputs=/proc/self/environ/x cannot be written: "),
    ],
)
def test_impossible_requests_end_at_once_with_one_sentence(
    said: list[str], message: str, tmp_path: Path, verb: Verb
) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    words = [*said, f"root={tmp_path}/data"]
    words += [] if any(w.startswith("outputs=") for w in said) else [f"outputs={tmp_path}/out"]
    process = verb(words)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, out) == (2, "")
    lines = [line for line in err.splitlines() if not line.startswith("experiment=")]
    assert len(lines) == 1
    assert re.search(message.replace("?", r"\?"), lines[0])
    assert not list(tmp_path.iterdir())
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 5  # torch is not even imported


def test_impossible_networks_and_devices_are_refused_before_generation(words: list[str], tmp_path: Path) -> None:
    for more, message in (
        ("trainer.schedule.vote_steps=12", "vote_steps must be less than the 12 steps of the training, or no pose"),
        ("loss.weights.refined=0.0", "loss.weights.refined must be greater than 0 with model.refinement"),
        ("model.confidence=exponential", "model.confidence must be quality with model.refinement.*refinement=null"),
        ("model.centers=[64,80,16,8]", "centers must fall from level to level"),
        ("trainer.accelerator=gpu", "trainer settings cannot be met: .*gpu"),
        ("trainer.precision=16-mixed", "trainer.precision=16-mixed must be trained on a GPU, got the CPU"),
        ("trainer.schedule.milestones=[5,2]", "milestones must be rising"),
    ):
        if torch.cuda.is_available() and "gpu" in more:
            continue
        with pytest.raises(ConfigurationError, match=message):
            run(words, more, f"root={tmp_path}/data")
    assert not (tmp_path / "data").exists()


def test_the_whole_chain(
    words: list[str], tmp_path: Path, store: str, caplog: pytest.LogCaptureFixture, request: pytest.FixtureRequest
) -> None:
    from attentionvote.training.checkpoint import load_trained

    with caplog.at_level(logging.INFO, logger="attentionvote"):
        result = run(words)
    assert "brick: 8/2/2 scenes (train/val/test), 128 points," in caplog.text
    assert "on cpu (32-true, 1 thread)" in caplog.text
    assert {"stage", "object", "run_id", "model", "checkpoint", "metrics", "losses", "steps", "seconds"} <= set(result)
    assert (result["object"], result["steps"], result["test_scenes"]) == ("brick", 12, 2)
    assert {"ap_10", "ap_5", "ap_2", "precision_10", "recall_10", "add_recall_10"} <= set(result["metrics"])
    assert {"proposal_recall", "proposal_repeats", "proposal_strays", "proposal_count"} <= set(result["metrics"])
    first, last = result["losses"]["vote"]
    assert last < first
    model, metadata = load_trained(result["model"])
    assert metadata["confidence_threshold"] == result["confidence_threshold"]
    assert metadata["part"]["name"] == "brick"
    assert metadata["part"]["symmetry"]["kind"] == "cyclic"
    assert set(metadata["data"]) == {"train", "val", "test"}
    assert metadata["points"] == 128
    assert metadata["clouds"]["sensor"]["preset"] == "gaussian"
    assert metadata["test"]["ap_10"] == pytest.approx(result["metrics"]["ap_10"], abs=1e-4)
    assert not model.training
    best, _ = load_trained(result["checkpoint"])  # what was tested is the best checkpoint
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), best.parameters(), strict=True))
    folder = job_folder(tmp_path)
    assert sorted(p.name for p in folder.iterdir()) == [".lock", "checkpoints", "model.ckpt", "result.json", "run.json"]
    artifacts = Path(store).parent / "mlartifacts" / result["run_id"] / "artifacts"
    names = {str(p.relative_to(artifacts)) for p in artifacts.rglob("*") if p.is_file()}
    assert {
        "config.yaml", "result.json", "train/losses.png", "test/precision_recall.png", "test/ap_threshold.png",
        "test/scene_0.png", "val/scene_0/step_00000004.png", "val/scene_1/step_00000012.png",
        "checkpoints/model.ckpt", "checkpoints/best_val_ap.ckpt", "checkpoints/last.ckpt", "test/figures.json",
    } <= names  # fmt: skip
    check_record(store, result, folder)

    # Complete: the stored result, without another training.
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        assert run(words) == result
    assert "is complete, made at commit " in caplog.text
    assert run(words, "data.workers=1", "trainer.threads=2") == result  # what is learned does not depend on them
    # The model is gone: only the test is done again, in the same run.
    request.getfixturevalue("cheap_figures")
    (folder / "model.ckpt").unlink()
    caplog.clear()
    again = run(
        words, "data.workers=1", "trainer.threads=2", "tracking.system_interval=60", "trainer.log_every_steps=7"
    )
    assert "resumed with other parameters" not in caplog.text  # they do not identify the training
    assert (again["run_id"], again["metrics"], again["steps"]) == (result["run_id"], result["metrics"], 12)
    # Repeated on demand, in a run of its own.
    repeated = run(words, "force=true")
    assert repeated["run_id"] != result["run_id"]
    assert all(torch.equal(a, b) for a, b in zip(weights(repeated).values(), weights(again).values(), strict=True))


def check_record(store: str, result: dict[str, Any], folder: Path) -> None:
    """What MLflow's pages show of a complete training: settings, tags, datasets, metrics, a table, a description."""
    import mlflow.data

    from attentionvote.tracking.store import connect, resolve_store

    client = connect(resolve_store(store))
    stored = client.get_run(result["run_id"])
    params, tags, metrics = stored.data.params, stored.data.tags, stored.data.metrics
    assert params["object"] == "brick"
    assert (params["epochs"], params["trainer.max_epochs"], params["learning_rate"]) == ("6", "6", "0.003")
    assert params["model.centers"] == "[64, 32, 16, 8]"
    assert {"loss.weights.vote", "data.sensor.preset", "trainer.average_decay", "simulation.cycles.train"} <= set(
        params
    )
    outside = (
        "tracking.",
        "cluster.",
        "trainer.threads",
        "trainer.log_every",
        "workers",
        "root",
        "outputs",
        "data.held",
    )
    assert not [name for name in params if name.startswith(outside)]
    assert stored.info.run_name == f"brick smoke s0 6e {folder.name[:6]}"
    assert (tags["preset"], tags["part"], tags["sensor"], tags["seed"]) == ("smoke", "brick", "gaussian", "0")
    assert len(tags["part.digest"]) == 64
    assert "| ap_10 |" in tags["mlflow.note.content"]
    tests = {name for name in metrics if name.startswith("test/")}
    assert {"test/ap_10", "test/ap_5", "test/ap_2", "test/confidence_threshold"} <= tests
    assert len(tests) <= 9
    assert {"train/learning_rate", "train/gradient_norm"} <= set(metrics)
    table = json.loads(Path(client.download_artifacts(result["run_id"], "test/figures.json")).read_text())
    assert dict(table["data"]).keys() == result["metrics"].keys()
    assert json.loads(tags["mlflow.loggedArtifacts"]) == [{"path": "test/figures.json", "type": "table"}]
    data = {entry.tags[0].value: entry.dataset for entry in stored.inputs.dataset_inputs}
    assert set(data) == {"train", "val", "test"}
    profile = json.loads(data["train"].profile)
    assert (data["train"].name, profile["scenes"], profile["cycles"]) == ("brick/train", 8, 4)
    assert profile["digest"] == params["data.train"]
    assert (Path(mlflow.data.get_source(data["train"]).uri) / "manifest.json").is_file()


class Full:
    """Every checkpoint from the second one on finds the disk full."""

    def __init__(self) -> None:
        self.calls, self.fsync = 0, os.fsync

    def __call__(self, descriptor: int) -> None:
        self.calls += 1
        if self.calls >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.fsync(descriptor)


@CHEAP
def test_a_full_disk_a_lost_store_a_torn_checkpoint(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", Full())
        with pytest.raises(OSError, match=r"best.ckpt cannot be written \(No space left on device\)") as error:
            run(words)
    assert "\n" not in str(error.value)
    folder = job_folder(tmp_path)
    assert not leftovers(folder)
    assert not (folder / "result.json").exists()
    first = json.loads((folder / "run.json").read_text())["run_id"]
    # The next call: half a checkpoint, and a store that does not know the run.
    last = folder / "checkpoints" / "last.ckpt"
    last.write_bytes(last.read_bytes()[:2000])
    (folder / "run.json").write_text('{"run_id": "0123456789abcdef0123456789abcdef"}')
    caplog.clear()
    result = run(words)
    assert "last.ckpt cannot be read (RuntimeError) and is passed over" in caplog.text
    assert "is gone from the store: the training goes on in a new one" in caplog.text
    assert result["steps"] == 12
    assert result["run_id"] not in (first, "0123456789abcdef0123456789abcdef")


@CHEAP
def test_an_end_without_validation_keeps_the_last_weights(words: list[str]) -> None:
    result = run(words, "trainer.max_epochs=1", "trainer.average_decay=0")
    assert result["checkpoint"].endswith("last.ckpt")
    assert result["steps"] == 2


def test_one_process_a_training(words: list[str], verb: Verb) -> None:
    from attentionvote.workflows.train.job import find_training

    with find_training(compose(TrainSettings, words)).locked():
        process = verb(words)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, out) == (2, "")
    assert "train: another process is at this training" in err


@CHEAP
def test_damaged_data_is_one_sentence(words: list[str], root: Path, tmp_path: Path) -> None:
    run(words, "trainer.max_epochs=1")  # data at the latest now
    own = tmp_path / "data"
    shutil.copytree(root, own)
    for points in own.glob("clouds/brick/*/points.npy"):
        np.load(points, mmap_mode="r+")[:] = np.nan
    for workers in (0, 1):
        with pytest.raises(ValueError, match=r"damaged .*must be finite.*: delete the folder") as error:
            run(words, "trainer.max_epochs=2", f"data.workers={workers}", f"root={own}", "resume=never")
        assert "\n" not in str(error.value)
        assert str(error.value).startswith("cloud ")
    for manifest in own.glob("scenes/brick/*/manifest.json"):
        manifest.write_text("{")
    with pytest.raises(ValueError, match=r"manifest.json must be the manifest of a scene set"):
        run(words, f"root={own}")


def until(process: subprocess.Popen[str], ready: Callable[[], bool]) -> None:
    """Wait for something that the process is about to do."""
    deadline = time.monotonic() + 200
    while not ready():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.timeout(900)
@CHEAP
def test_killed_anywhere_and_continued_ends_the_same(
    words: list[str], tmp_path: Path, store: str, verb: Verb, caplog: pytest.LogCaptureFixture
) -> None:
    words = [*words, "trainer.max_epochs=16", "trainer.validate_every=8"]
    whole = run(words, f"outputs={tmp_path}/whole")
    killed_at = []
    for workers in (0, 1):  # in the middle of an epoch, with and without a loader process
        process = verb([*words, f"data.workers={workers}"], warm=bool(workers))
        last = tmp_path / "out" / "brick" / Path(whole["model"]).parent.name / "checkpoints" / "last.ckpt"
        before = last.stat().st_mtime_ns if last.exists() else 0
        until(process, lambda last=last, before=before: last.exists() and last.stat().st_mtime_ns > before)  # type: ignore[misc]
        process.send_signal(signal.SIGKILL)
        process.communicate()
        killed_at.append(torch.load(last, weights_only=True)["global_step"])
    run_id = json.loads((job_folder(tmp_path) / "run.json").read_text())["run_id"]
    # To the end in this process, which has imported everything already.
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        result = run(words, "data.workers=1")
    assert 0 < killed_at[0] < killed_at[1] < 32
    assert (result["steps"], result["run_id"]) == (32, run_id)
    assert "going on after an interruption" in caplog.text
    assert "Traceback" not in caplog.text
    for name, value in weights(whole).items():
        assert torch.equal(value, weights(result)[name]), name
    assert result["metrics"] == whole["metrics"]
    ends = [torch.load(Path(r["checkpoint"]).with_name("last.ckpt"), weights_only=True) for r in (whole, result)]
    for key in ("state_dict", "current_model_state"):
        assert all(torch.equal(a, ends[1][key][name]) for name, a in ends[0][key].items())
    histories = []
    for r in (whole, result):
        with start_run(store, run_id=r["run_id"], system_interval_s=0) as tracked:
            histories.append({name: tracked.metric_history(f"train/{name}") for name in CURVES})
    assert histories[0] == histories[1]  # unbroken curves
    assert all(steps == list(range(32)) for steps, _ in histories[0].values())


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_during_training(
    words: list[str], tmp_path: Path, store: str, verb: Verb, number: int, code: int
) -> None:
    words = [*words, "trainer.max_epochs=400", "data.workers=1"]
    process = verb(words, start_new_session=True)
    checkpoints = tmp_path / "out" / "brick"
    until(process, lambda: any(checkpoints.rglob("last.ckpt")))
    os.killpg(process.pid, number)  # as a terminal does: the whole group
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (code, "")
    assert err.count("interrupted") == 1
    assert err.splitlines()[-1] == "train: interrupted; run the same command to resume"
    assert "Traceback" not in err
    folder = job_folder(tmp_path)
    assert not leftovers(folder)
    assert not (folder / "result.json").exists()
    from attentionvote.tracking.store import connect, resolve_store

    run_id = json.loads((folder / "run.json").read_text())["run_id"]
    assert connect(resolve_store(store)).get_run(run_id).info.status == "KILLED"


@pytest.mark.parametrize(("module", "moment"), [("data", "measure_clouds"), ("run", "assess")])
@CHEAP
def test_ctrl_c_at_other_moments(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, moment: str
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(importlib.import_module(f"attentionvote.workflows.train.{module}"), moment, interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(words)
    folder = job_folder(tmp_path)
    assert not leftovers(folder)
    run_file = folder / "run.json"
    before = json.loads(run_file.read_text())["run_id"] if run_file.exists() else None
    result = run(words)
    assert result["steps"] == 12
    assert before in (None, result["run_id"])
