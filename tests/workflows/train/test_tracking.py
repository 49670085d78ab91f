"""What a training tells MLflow: parameters, name, labels, description."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.workflows.train.job import TrainingJob, find_training
from attentionvote.workflows.train.settings import TrainSettings
from attentionvote.workflows.train.tracking import labels, parameters, preset, run_name


@pytest.fixture
def training(tmp_path: Path):
    """The settings and the job of a training that is only described."""

    def make(*words: str) -> tuple[TrainSettings, TrainingJob]:
        cfg = compose(TrainSettings, ["object=brick", *TINY_TRAINING, f"outputs={tmp_path / 'out'}", *words])
        return cfg, find_training(cfg)

    return make


def test_every_setting_that_makes_another_training_makes_other_parameters(training) -> None:
    before = parameters(*training(), weights=7)
    for word, name in (
        ("loss.weights.vote=3.5", "loss.weights.vote"),
        ("model.fusion_kind=pn", "model.fusion_kind"),
        ("data.sensor.edge_dropout=0.25", "data.sensor.edge_dropout"),
        ("trainer.weight_decay=0.125", "trainer.weight_decay"),
        ("trainer.schedule.milestones=[1,2]", "trainer.schedule.milestones"),
        ("simulation.drop_counts=[1,2]", "simulation.drop_counts"),
        ("optimizer={_target_: torch.optim.SGD, momentum: 0.5}", "optimizer.momentum"),
        ("seed=5", "seed"),
    ):
        cfg, job = training(word)
        after = parameters(cfg, job, weights=7)
        assert before.get(name) != after[name], name
        assert job.directory != training()[1].directory
    assert before["model.centers"] == "[64, 32, 16, 8]"
    assert before["object"] == "brick"
    assert before["trainer.learning_rate"] == str(before["learning_rate"])
    assert before["trainer.max_epochs"] == str(before["epochs"])
    assert (before["parameters"], before["model.classes"]) == (7, 1)
    assert not [name for name, value in before.items() if not isinstance(value, str | int | float)]


def test_what_may_differ_in_a_training_that_goes_on_is_no_parameter(training, tmp_path) -> None:
    before = parameters(*training(), weights=7)
    cfg, job = training(
        "trainer.threads=3", "workers=3", f"root={tmp_path}", "tracking.system_interval=7", "data.workers=2",
        "cluster.gpus=1", "trainer.log_every_steps=3", "force=true", "resume=never", "object.title=Another",
    )  # fmt: skip
    assert parameters(cfg, job, weights=7) == before
    assert job.directory == training()[1].directory


def test_a_name_and_labels_tell_runs_apart(training) -> None:
    cfg, job = training("seed=3", "trainer.max_epochs=7")
    assert run_name(cfg, job) == f"brick smoke s3 7e {job.directory.name[:6]}"
    tags = labels(cfg, job)
    assert (tags["preset"], tags["part"], tags["part.digest"]) == ("smoke", "brick", job.part.digest)
    assert (tags["sensor"], tags["seed"]) == (cfg.data.sensor.preset, 3)
    assert "init" not in tags


@pytest.mark.parametrize(
    ("words", "name"), [([], "none"), (["experiment=gpu", "experiment=paper"], "paper"), (["experiment=null"], "none")]
)
def test_the_preset_is_the_experiment_of_the_words(words: list[str], name: str) -> None:
    cfg = compose(TrainSettings, ["object=brick"])
    object.__setattr__(cfg, "words", tuple(words))
    assert preset(cfg) == name


def test_an_init_is_a_label_because_its_content_identifies(training, tmp_path) -> None:
    file = tmp_path / "a.ckpt"
    file.write_bytes(b"weights")
    cfg, job = training(f"init={file}")
    assert labels(cfg, job)["init"] == str(file)
    assert "init" not in parameters(cfg, job, weights=7)
    assert json.dumps(parameters(cfg, job, weights=7))
