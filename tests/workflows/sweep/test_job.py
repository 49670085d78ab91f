"""make sweep from end to end with real trainings: killed, continued, pruned, reported; the best is an experiment."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import optuna
import pytest
import sweep
import warm_starter
from optuna.trial import TrialState

from attentionvote.command.conf_folder import CONF
from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.workflows.sweep.job import SweepJob
from attentionvote.workflows.sweep.report import MARK, check_save_as, experiment_text
from attentionvote.workflows.sweep.settings import SweepSettings
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

ROOT = Path(__file__).resolve().parents[3]
EPOCHS = 4
TINY = [
    "object=brick", "experiment=smoke", "sweep=smoke", "simulation.cycles.train=4", "simulation.drop_counts=[1]",
    "data.density=1500", "data.pool=800", "data.points=128", "trainer.batch_size=4", f"trainer.max_epochs={EPOCHS}",
    "trainer.validate_every=1", "trainer.threads=1", "trainer.average_decay=0.5", "trainer.precision=32-true",
    "trainer.accelerator=cpu", "trainer.schedule.vote_steps=1", "trainer.schedule.ramp_steps=1",
    "tracking.system_interval=0", "model.centers=[64,32,16,8]", "model.neighbors=[8,8,8,8]",
    "model.widths=[[8,16],[16,16],[16,16],[16,16]]", "model.propagation=[16,16]", "model.voting=[16]",
    "model.fusion=[16,16]", "model.head=[16]", "model.refinement.points=16", "model.refinement.widths=[8,16]",
    "model.refinement.head=[16]", "sweep.pruner.least_epochs=1",
]  # fmt: skip


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    places = {"root": "data", "outputs": "train", "sweeps": "sweep", "tracking.store": "mlflow.db"}
    return [*TINY, *(f"{name}={tmp_path / place}" for name, place in places.items())]


def sweep_of(words: list[str]) -> SweepJob:
    """The sweep that the words mean, its study open."""
    job = SweepJob(compose(SweepSettings, words), sweep.training_words(words), "smoke")
    job.folder.mkdir(parents=True, exist_ok=True)
    job.open()
    return job


def run(words: list[str]) -> dict[str, Any]:
    return json.loads(json.dumps(sweep.run(compose(SweepSettings, words))))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_killed_continued_pruned_reported_and_trained_with(words: list[str], tmp_path: Path) -> None:
    start_run(str(tmp_path / "mlflow.db"), "warm", system_interval_s=0).close()
    command = [sys.executable, "pipelines/sweep.py", *words]
    process = subprocess.Popen([*command, "trials=1"], cwd=ROOT, text=True, stdout=-1, stderr=-1)
    job = sweep_of(words)
    deadline = time.monotonic() + 300
    while not (job.ledger.trials and max(job.ledger.trials[0].intermediate_values, default=0) >= 2):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.communicate()
    (killed,) = job.ledger.trials
    assert killed.state == TrialState.RUNNING
    # Four good trials, as if they had been run: what comes after them is pruned; trial 0 is past their reports.
    distributions = {
        setting.name: optuna.distributions.FloatDistribution(setting.low, setting.high, log=True)
        for setting in job.space
    }
    for index in range(4):
        params = {"trainer.learning_rate": 0.002 + 0.001 * index, "loss.weights.vote": 2.0}
        job.ledger.study.add_trial(
            optuna.create_trial(
                value=0.5 + 0.1 * index, params=params, distributions=distributions, intermediate_values={1: 0.9}
            )
        )
    process = warm_starter.Popen([*command, "trials=6", "workers=2"], cwd=ROOT, text=True, stdout=-1, stderr=-1)
    out, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert "Warning" not in err
    result = json.loads(out)
    first, *good, pruned = job.ledger.trials
    # Trial 0 went on, once, with its own parameters, from its checkpoint, in its own run.
    assert (first.number, first.params, first.state) == (0, killed.params, TrialState.COMPLETE)
    assert set(first.intermediate_values) == set(range(1, EPOCHS + 1))
    assert first.value == max(first.intermediate_values.values())  # val/ap of the best checkpoint
    assert "going on after an interruption" in (job.folder / "logs" / "trial_000.log").read_text()
    assert len(good) == 4
    assert (pruned.number, pruned.state) == (5, TrialState.PRUNED)
    assert set(pruned.intermediate_values) == {1}
    assert "Traceback" not in (job.folder / "logs" / "trial_005.log").read_text()
    folder = Path(pruned.user_attrs["directory"])
    assert (folder / "checkpoints" / "last.ckpt").exists()
    assert not (folder / "result.json").exists()  # no training that is taken for complete
    assert result["states"] == {"complete": 5, "pruned": 1}
    # MLflow: a parent, a child a trial.
    client = connect(resolve_store(str(tmp_path / "mlflow.db")))
    runs = {r.info.run_id: r for r in client.search_runs([client.get_experiment_by_name("brick").experiment_id])}
    parent = runs.pop(result["run_id"])
    assert parent.info.status == "FINISHED"
    assert (parent.data.tags["sweep.complete"], parent.data.tags["sweep.pruned"]) == ("5", "1")
    assert {r.data.tags["mlflow.parentRunId"] for r in runs.values()} == {parent.info.run_id}
    assert {r.data.tags["sweep.trial"]: (r.data.tags["sweep.state"], r.info.status) for r in runs.values()} == {
        "0": ("complete", "FINISHED"), "5": ("pruned", "KILLED"),
    }  # fmt: skip
    kept = {item.path for item in client.list_artifacts(parent.info.run_id)}
    assert {"trials.html", "trials.csv", "trials.json", "best.yaml", "config.yaml"} <= kept
    assert set(result["importance"]) == {setting.name for setting in job.space}
    with (job.folder / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["complete"] * 5 + ["pruned"]
    assert rows[0]["run_id"] in runs
    # The same command does nothing more; the best settings are an experiment that means the same training.
    assert run([*words, "trials=6"])["best"] == result["best"]
    assert len(job.ledger.trials) == 6
    best = result["best"]
    assert (best["trial"], best["values"]["trainer.learning_rate"]) == (4, pytest.approx(0.005))
    assert Path(result["experiment"]) == tmp_path / "sweep" / "brick" / "best.yaml"
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    shutil.copy(result["experiment"], conf / "experiment" / "rod.yaml")
    found = find_training(compose(TrainSettings, ["object=brick", "experiment=rod"], conf))
    assert found.directory.name == job.directory(best["values"]).name


@pytest.mark.slow
def test_a_sweep_of_failures_says_why(words: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = [*words, "outputs=/proc/version/x", "trials=1"]
    with pytest.raises(ValueError, match=r"of 1 trials 1 failed and none is complete; trial 0: outputs=.*x cannot be"):
        run(words)
    assert "trial 0 failed: outputs=/proc/version/x cannot be written" in caplog.text
    (row,) = json.loads(next(tmp_path.glob("sweep/brick/*/trials.json")).read_text())
    assert (row["state"], row["val_ap"], row["run_id"]) == ("fail", None, None)
    assert row["reason"].startswith("outputs=/proc/version/x cannot be written")


@pytest.mark.slow
def test_a_study_that_has_its_total_is_reported_without_a_worker(words: list[str], tmp_path: Path) -> None:
    job = sweep_of(words)
    distributions = {s.name: optuna.distributions.FloatDistribution(s.low, s.high, log=True) for s in job.space}
    for index in range(4):
        params = {"trainer.learning_rate": 0.002 + 0.001 * index, "loss.weights.vote": 2.0}
        made = optuna.create_trial(value=0.5 + 0.1 * index, params=params, distributions=distributions)
        job.ledger.study.add_trial(made)
    result = run([*words, "trials=4", "executor=ray", "cluster.address=203.0.113.1:6379"])  # where there is no cluster
    assert result["states"] == {"complete": 4}
    assert result["best"]["trial"] == 3
    assert {"trials.html", "best.yaml", "trials.csv"} <= {path.name for path in job.folder.iterdir()}
    assert (tmp_path / "sweep" / "brick" / "best.yaml").read_text() == (job.folder / "best.yaml").read_text()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("trails=3", "there is no setting 'trails', did you mean 'trials'?"),
        ("trials=0", "trials must be at least 1 and at most 1000000; got 0"),
        ("sweep=smok", "sweep must be one of compact, smoke; got 'smok', did you mean 'smoke'?"),
        ("sweep.pruner.kind=medain", "sweep.pruner.kind must be one of .*; got 'medain', did you mean 'median'?"),
        ("trainer.validate_every=9", "trainer.max_epochs must be at least trainer.validate_every"),
        ("sweep.space=[{name: seed, kind: int, low: 2, high: 1}]", "low must be less than high, got 2 and 1"),
        ("save_as=paper", "save_as must not replace a file that no sweep wrote, got 'paper'"),
        ("save_as=smoke", "save_as must not replace a file that no sweep wrote"),
        ("executor=rya", "executor must be one of local, ray, slurm; got 'rya', did you mean 'ray'?"),
        ("save_as=a/b", "save_as must be a name of letters, digits, - and _, got 'a/b'"),
        ("storage=nonsense", "storage must be the SQLAlchemy URI of a database that answers.*got nonsense"),
        ("~model.merge_fraction", "model.merge_fraction can be changed, not taken away"),
        ("~trainer.log_every_steps", "trainer.log_every_steps must be given"),
    ],
)
def test_an_impossible_sweep_is_refused_before_any_work(
    words: list[str], tmp_path: Path, more: str, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message.replace("?", r"\?")):
        run([*words, more])
    assert not list(tmp_path.glob("train/*"))
    assert not list(tmp_path.glob("data/*"))


def test_the_study_is_named_by_what_it_searches_not_by_how_it_is_run(words: list[str]) -> None:
    def name(*more: str) -> str:
        said = [*words, *more]
        return SweepJob(compose(SweepSettings, said), sweep.training_words(said), "smoke").name

    same = name()
    assert same.startswith("brick-smoke-")
    assert name("trials=9", "workers=2", "retries=0", "save_as=x", "trainer.threads=2", "force=true") == same
    assert len({same, name("trainer.max_epochs=7"), name("sweep.pruner.kind=none")}) == 3


def test_where_trials_run_is_no_business_of_their_trainings(words: list[str]) -> None:
    place = ["executor=slurm", "cluster.gpus=1.0", "cluster.slurm.minutes=9", "threads=4", "workers=8"]
    assert sweep.training_words([*words, *place]) == sweep.training_words(words)
    assert sweep.preset_of_trials(["object=gear,brick", *place]) == ["experiment=gpu"]
    assert sweep.preset_of_trials(["object=gear", "executor=ray"]) == ["experiment=compact"]
    assert sweep.preset_of_trials(["object=gear", "executor=ray", "experiment=paper"]) == []


def test_trials_of_one_machine_share_its_gpus(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")

    def gpu(slot: int, *more: str) -> str | None:
        return sweep_of([*words, *more])._environment(9, slot).get("CUDA_VISIBLE_DEVICES")

    assert [gpu(slot, "workers=3") for slot in range(3)] == ["4", "6", "4"]
    assert gpu(0, "workers=1") is None
    assert gpu(0, "workers=3", "executor=ray") is None  # Ray's business


def test_a_file_is_no_study_for_several_machines(words: list[str], caplog: pytest.LogCaptureFixture) -> None:
    def warned(*more: str) -> bool:
        caplog.clear()
        said = [*words, *more]
        SweepJob(compose(SweepSettings, said), sweep.training_words(said), "smoke")
        return "the study is an SQLite file" in caplog.text

    assert warned("executor=ray", "cluster.address=auto")
    assert not warned("executor=ray", "cluster.address=auto", "storage='postgresql://me@database/sweeps'")
    assert not warned("executor=ray")
    assert not warned("executor=slurm", "cluster.slurm.system=local")
    assert not warned()


def test_an_experiment_says_what_the_sweep_was_given(tmp_path: Path) -> None:
    given = [
        "object=brick", "experiment=compact", "data=smoke", "trainer.max_epochs=12", "model.merge_fraction=null",
        "data.augmentation={roll: false, tilt: 0.1, jitter_mm: 0.5}", "outputs=x", "tracking.store=y.db",
        "trainer.schedule.shape='step'", "trainer.schedule.milestones=[2,3]",
    ]  # fmt: skip
    values = {"trainer.learning_rate": 1e-05, "model.widths": [[8, 16]] * 4, "data.augmentation.tilt": 0.2}
    text = experiment_text(given, values, "Trial 3.")
    assert text.startswith("# @package _global_\n# Trial 3.\n")
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    (conf / "experiment" / "mine.yaml").write_text(text, encoding="utf-8")
    got = compose(TrainSettings, ["object=brick", "experiment=mine"], conf)
    said = compose(TrainSettings, [*given, *(f"{k}={json.dumps(v)}" for k, v in values.items())])
    for section in ("model", "data", "trainer", "loss", "simulation"):
        assert got.composed[section] == said.composed[section], section
    assert got.outputs != "x"
    # A file that a sweep wrote may be written again.
    assert MARK in text
    check_save_as("mine", conf / "experiment")
    check_save_as("2024mine", conf / "experiment")
    for name in ("mine", "next"):  # chosen itself, and reachable from the chosen one
        (conf / "experiment" / "next.yaml").write_text(f"# {MARK}\ndefaults: [mine, _self_]\n", encoding="utf-8")
        with pytest.raises(ConfigurationError, match="save_as must not name an experiment that the sweep builds on"):
            check_save_as(name, conf / "experiment", ["experiment=next"])
