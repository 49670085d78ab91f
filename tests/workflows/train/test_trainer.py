"""Lightning's switches, callbacks, loggers, optimizers and schedules: what a training makes of them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
import torch
import train
from lightning.pytorch.callbacks import Callback
from tiny_training import TINY_TRAINING

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.tracking.store import connect, resolve_store
from attentionvote.workflows.train.settings import TrainSettings

pytestmark = pytest.mark.usefixtures("quick_training")
TINY = [
    "object=brick", *TINY_TRAINING, "simulation.drop_counts=[1,2]", "workers=1", "trainer.max_epochs=4",
    "trainer.validate_every=2", "trainer.average_decay=0.5", "force=false",
]  # fmt: skip
SEEN: list[str] = []


class Witness(Callback):
    """What a user's callback sees."""

    def __init__(self, name: str, fail: bool = False) -> None:
        if fail:
            raise RuntimeError("no such thing")
        self.name = name

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        """Note the trainer's state."""
        del pl_module
        optimizer = trainer.optimizers[0]
        SEEN.append(
            f"{self.name}: {type(optimizer).__name__} {trainer.global_step} steps, {trainer.current_epoch} epochs, "
            f"rate {optimizer.param_groups[0]['lr']:.4f}, decay {optimizer.param_groups[0]['weight_decay']}"
        )


@pytest.fixture
def run(tmp_path: Path, store: str, data: Path) -> Any:
    """Trains with further words."""
    SEEN.clear()
    words = [*TINY, f"root={data}", f"outputs={tmp_path}", f"tracking.store={store}", *WITNESS]
    return lambda *more: json.loads(json.dumps(train.run(compose(TrainSettings, [*words, *more]))))


WITNESS = [f"callbacks.witness._target_={__name__}.Witness", "callbacks.witness.name=w"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene sets and clouds, made by the first training."""
    return tmp_path_factory.mktemp("data")


def folders(tmp_path: Path) -> list[Path]:
    return [path for path in (tmp_path / "brick").iterdir() if path.is_dir()]


def test_a_few_batches_to_try_the_code_leave_nothing(run: Any, tmp_path: Path, store: str) -> None:
    before = len(connect(resolve_store(store)).search_experiments())
    answer = run("trainer.fast_dev_run=2")
    assert (answer["fast_dev_run"], answer["steps"], "metrics" in answer) == (2, 2, False)
    assert [path.name for path in folders(tmp_path)[0].iterdir()] == [".lock"]
    assert len(connect(resolve_store(store)).search_experiments()) == before
    assert SEEN[0].startswith("w: AdamW 2 steps, 1 epochs")


def test_switches_reach_lightning(run: Any, tmp_path: Path) -> None:
    try:
        answer = run(
            "trainer.accumulate_grad_batches=2", "trainer.limit_val_batches=1", "trainer.max_steps=3",
            "trainer.deterministic=true", "trainer.profiler=simple",
        )  # fmt: skip
        assert torch.are_deterministic_algorithms_enabled()
    finally:
        torch.use_deterministic_algorithms(False)
    assert answer["steps"] == 3  # two batches an epoch make one step
    assert SEEN[0].startswith("w: AdamW 3 steps, 3 epochs")
    (profile,) = folders(tmp_path)[0].glob("*profile.txt")
    assert "run_training_batch" in profile.read_text()
    assert run("trainer.limit_train_batches=0.5")["steps"] == 4


def test_loggers_stand_beside_mlflow_and_early_stopping_ends(run: Any, tmp_path: Path) -> None:
    answer = run(
        "callbacks=early_stopping", "callbacks.early_stopping.patience=1", "loggers=csv", "trainer.validate_every=1"
    )
    assert answer["steps"] == 4  # the second validation is no better than the first
    (metrics,) = (tmp_path / "loggers" / "csv" / "brick" / "version_0").glob("metrics.csv")
    rows = list(csv.DictReader(metrics.read_text().splitlines()))
    logged = [float(row["train/loss"]) for row in rows if row["train/loss"]]
    assert len(logged) == 4
    assert len(answer["losses"]["vote"]) == 2  # MLflow has them too


SCHEDULES = "schedule._target_=torch.optim.lr_scheduler."


@pytest.mark.parametrize(
    ("words", "end"),
    [
        ("optimizer._target_=torch.optim.SGD optimizer.momentum=0.9", "SGD 8 steps, 4 epochs, rate 0.0000, decay 0.01"),
        (
            "optimizer._target_=torch.optim.RAdam optimizer.lr=0.5 optimizer.weight_decay=0.2 optimizer._partial_=true "
            "trainer.schedule.shape=constant trainer.schedule.rise_steps=0",
            "RAdam 8 steps, 4 epochs, rate 0.5000, decay 0.2",
        ),
        (
            f"{SCHEDULES}ExponentialLR schedule.gamma=0.5 trainer.learning_rate=0.016",
            "AdamW 8 steps, 4 epochs, rate 0.0010, decay 0.01",
        ),
        (
            f"{SCHEDULES}ExponentialLR schedule.gamma=0.5 schedule.interval=step trainer.learning_rate=0.256",
            "AdamW 8 steps, 4 epochs, rate 0.0010, decay 0.01",
        ),
        (  # torch's own value after 8 steps of 8
            f"{SCHEDULES}OneCycleLR schedule.max_lr=0.01 schedule.final_div_factor=0.1",
            "AdamW 8 steps, 4 epochs, rate 0.0045, decay 0.01",
        ),
        (
            f"{SCHEDULES}ReduceLROnPlateau schedule.patience=0 schedule.threshold=0.1 trainer.learning_rate=0.01",
            "AdamW 8 steps, 4 epochs, rate 0.0010, decay 0.01",
        ),
    ],
)
def test_optimizers_and_schedules_of_torch_are_named(run: Any, words: str, end: str) -> None:
    assert run(*words.split())["steps"] == 8
    assert [f"w: {end}"] == SEEN


def test_what_cannot_be_made_is_one_sentence(run: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"^callbacks\.witness cannot be made: RuntimeError: no such thing$"):
        run("callbacks.witness.fail=true")


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("+trainer.devices=2", "there is no setting 'trainer.devices': several processes share a training by"),
        ("devices=2", "there is no setting 'devices': several processes share a training by"),
        ("ckpt_path=x.ckpt", "init=FILE begins with the weights of another"),
        ("trainer.limit_test_batches=1", "the test set is tested whole"),
        ("trainer.check_val_every_n_epoch=1", "trainer.validate_every is the number"),
    ],
)
def test_names_of_elsewhere_are_answered(word: str, hint: str) -> None:
    with pytest.raises(ConfigurationError, match=hint):
        compose(TrainSettings, ["object=brick", word])
