"""What identifies a training: today's, and those of before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from attentionvote.command.configuration import compose
from attentionvote.command.identity import identifies, identity
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings


def of(*words: str, once: bool = False) -> str:
    return json.dumps(identity(compose(TrainSettings, ["object=brick", *words]), once=once), sort_keys=True)


def test_how_the_work_is_done_makes_no_other_training() -> None:
    how = [
        "root=x", "outputs=x", "resume=never", "force=true", "workers=3", "executor=ray", "cluster.gpus=1",
        "tracking.parent=x", "data.workers=2", "trainer.threads=2", "trainer.profiler=simple", "loggers=csv",
        "trainer.accumulate_grad_batches=1", "trainer.fast_dev_run=false", "init=null", "callbacks=[]",
    ]  # fmt: skip
    assert of(*how) == of()
    assert of(*how, once=True) == of(once=True)


def test_what_was_part_of_it_once_is_none_any_more() -> None:
    words = ["trainer.log_every_steps=3", "object.title=Brick"]
    assert of(*words) == of()
    assert len({of(*some, once=True) for some in ([], words[:1], words[1:])}) == 3


def test_what_changes_the_result_makes_another() -> None:
    words = [
        "trainer.validate_every=2", "trainer.accumulate_grad_batches=2", "trainer.limit_train_batches=0.5", "seed=1",
        "trainer.fast_dev_run=true", "trainer.deterministic=true", "callbacks=early_stopping", "model.refinement=null",
        "optimizer._target_=torch.optim.SGD",
        "schedule._target_=torch.optim.lr_scheduler.ExponentialLR schedule.gamma=1",
    ]  # fmt: skip
    assert len({of(*word.split()) for word in words} | {of()}) == len(words) + 1


def test_a_setting_says_whether_it_identifies() -> None:
    for name in ("seed", "trainer.learning_rate", "trainer.validate_every", "model.refinement.points"):
        assert identifies(TrainSettings, name)
    for name in ("root", "tracking.store", "cluster.slurm.folder", "trainer.threads", "trainer.log_every_steps"):
        assert not identifies(TrainSettings, name)


# The scenes, the network and the optimizer of before.
WHOLE = "~simulation.keep_every.test ~simulation.pile_share.train model.test_voting_share=1.0"
BEFORE = f"trainer=adamw simulation.cycles.test=10 {WHOLE}"
# Folders of trainings, computed by commit 11bac4c, before settings said whether they identify.
OF_BEFORE = {
    f"object=brick {BEFORE}": "07c4fb994275",
    f"object=connecting_rod experiment=votenet seed=3 {BEFORE}": "d6be5de89287",
    f"object=industrial {BEFORE}": "7a3258f24b86",
    f"object=gear experiment=smoke trainer.log_every_steps=7 {WHOLE}": "c66d0b8f1658",
    f"object=gear object.title=x {BEFORE}": "0eac54870e3d",
}


@pytest.mark.parametrize(("words", "digest"), OF_BEFORE.items())
def test_a_training_of_before_is_found_where_it_lies(words: str, digest: str, tmp_path: Path) -> None:
    cfg = compose(TrainSettings, [*words.split(), f"outputs={tmp_path}"])
    new = find_training(cfg).directory
    assert new.name != digest
    (new.parent / digest).mkdir(parents=True)
    assert find_training(cfg).directory.name == digest
    new.mkdir()  # begun under its new name since
    assert find_training(cfg).directory == new
