"""The settings executor and cluster: what they do to generate, and what they do not do to a training's identity."""

from __future__ import annotations

from pathlib import Path

import generate
import pytest

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.command.executors import executor_of
from attentionvote.execution import LocalPool, RayCluster, SlurmArray
from attentionvote.workflows.settings import GenerateSettings
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings

TINY = ["object=brick", "simulation=smoke", "simulation.cycles.train=2", "simulation.drop_counts=[1,2]"]


def test_settings_become_an_executor() -> None:
    assert executor_of(compose(GenerateSettings, TINY)) == LocalPool()
    ray = compose(GenerateSettings, [*TINY, "executor=ray", "cluster.address=auto", "cluster.gpus=0.5"])
    assert executor_of(ray) == RayCluster("auto", 0.5)
    slurm = ["executor=slurm", "cluster.slurm.system=local", "cluster.slurm.memory_gb=2.5", "cluster.slurm.minutes=9"]
    assert executor_of(compose(GenerateSettings, [*TINY, *slurm])) == SlurmArray(Path("outputs/slurm"), "local", 9, 2.5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["executor=dask"], "executor must be one of local, ray, slurm; got 'dask'"),
        (["executor=slrum"], "did you mean 'slurm'"),
        (["cluster.slurm.minutes=0"], "cluster.slurm.minutes must be at least 1 and at most 1000000; got 0"),
        (
            ["cluster.slurm.memory_gb=0"],
            "cluster.slurm.memory_gb must be a number greater than 0 and at most 100000; got 0",
        ),
        (["cluster.gpus=-1.0"], r"cluster.gpus must be at least 0 and at most 1024; got -1.0"),
    ],
)
def test_impossible_settings_are_one_sentence(words: list[str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        compose(TrainSettings, ["object=brick", "experiment=smoke", *words])


def test_an_executor_that_cannot_work_is_said_before_any_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        ConfigurationError, match="executor=slurm must be used where jobs can be submitted, but there is"
    ):
        generate.run(compose(GenerateSettings, [*TINY, f"root={tmp_path / 'scenes'}", "executor=slurm"]))
    assert not (tmp_path / "scenes").exists()
    with pytest.raises(ValueError, match="there is no sbatch here"):
        find_training(compose(TrainSettings, ["object=brick", "experiment=smoke", "executor=slurm"]))


def test_where_the_jobs_run_is_no_part_of_what_a_training_is() -> None:
    words = ["object=brick", "experiment=smoke"]
    plain = find_training(compose(TrainSettings, words))
    spread = ["executor=ray", "cluster.address=auto", "cluster.gpus=1.0", "cluster.slurm.minutes=3", "workers=64"]
    assert find_training(compose(TrainSettings, [*words, *spread])).directory == plain.directory
    assert find_training(compose(TrainSettings, [*words, "seed=1"])).directory != plain.directory


@pytest.mark.slow
def test_generate_through_submitted_jobs_is_the_same_set(tmp_path: Path) -> None:
    one = [*TINY, "splits=[train]"]
    here = generate.run(compose(GenerateSettings, [*one, f"root={tmp_path / 'here'}", "workers=1"]))
    folder = tmp_path / "slurm"
    spread = ["executor=slurm", "cluster.slurm.system=local", f"cluster.slurm.folder={folder}", "workers=2"]
    there = generate.run(compose(GenerateSettings, [*one, f"root={tmp_path / 'there'}", *spread]))
    assert there["sets"]["train"]["digest"] == here["sets"]["train"]["digest"]
    assert list(folder.iterdir()) == []  # what a call needed is removed when it succeeds
