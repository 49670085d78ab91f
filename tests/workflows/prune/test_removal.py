"""Removal of what was judged before: interrupted, or with a process that came meanwhile."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest
from prune_workshop import Workshop

from attentionvote.command.configuration import compose
from attentionvote.files import locked_folder
from attentionvote.workflows.prune.judgement import judge
from attentionvote.workflows.prune.removal import remove_part
from attentionvote.workflows.prune.settings import PruneSettings


def test_a_prune_that_was_killed_leaves_nothing_half_and_the_next_one_ends_it(
    workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:

        def kill(path: Path) -> None:
            raise KeyboardInterrupt(str(path))

        patch.setattr(shutil, "rmtree", kill)
        with pytest.raises(KeyboardInterrupt, match=r"\.removed-"):
            workshop.prune("remove=true")
    (half,) = Path("outputs/train/brick").glob(".removed-*")
    assert not (half / "result.json").exists()  # else it would be a complete training to make export
    assert not half.with_name(half.name.removeprefix(".removed-")).exists()
    assert workshop.paths("leftover") == {half.name}
    workshop.prune("remove=true")
    assert not half.exists()
    assert len(list(Path("outputs/train/brick").iterdir())) == 1


def test_a_training_that_starts_meanwhile_is_not_torn(workshop: Workshop, caplog: pytest.LogCaptureFixture) -> None:
    cfg = compose(PruneSettings, ["tracking.store=mlflow.db"])
    things = [t for t in judge(cfg, time.time())["brick"].unreferenced if t.kind != "checkpoints"]
    before = sorted(path.name for path in Path("data").rglob("*"))
    with locked_folder(Path("outputs/train/brick/new"), "outputs", "training"):
        gone = remove_part(cfg, "brick", things)
    assert {path.name for path in gone} == {workshop.training(name).name for name in ("oldest", "middle")}
    assert sorted(path.name for path in Path("data").rglob("*")) == before
    assert "6 of 8 things of brick stay: a process is at outputs/train/brick/new by now" in caplog.text


def test_a_training_that_is_taken_up_meanwhile_stays_with_all_below_it(workshop: Workshop) -> None:
    cfg = compose(PruneSettings, ["tracking.store=mlflow.db"])
    things = [t for t in judge(cfg, time.time())["brick"].unreferenced if t.kind == "training"]
    with locked_folder(things[0].path, "outputs", "training"):
        assert remove_part(cfg, "brick", things) == set()
    assert (workshop.training("oldest") / "result.json").is_file()
    assert (workshop.training("middle") / "result.json").is_file()


def test_temporary_files_of_killed_processes_go_when_they_are_old(workshop: Workshop) -> None:
    newest = workshop.training("newest").relative_to(workshop.folder)
    remains = [newest / "checkpoints/.last.123.ckpt", Path("data/clouds/brick") / ".count.77.npy"]
    draft = Path("outputs/export/brick/.writing-bundle/golden")
    draft.mkdir(parents=True)
    for path in remains:
        path.write_text("half")
    assert workshop.paths("leftover") == set()
    for path in [*remains, draft.parent]:
        os.utime(path, (time.time() - 4000,) * 2)
    with locked_folder(newest, "outputs", "training"):
        assert workshop.paths("leftover") == {".count.77.npy", ".writing-bundle"}
    assert workshop.paths("leftover") == {".last.123.ckpt", ".count.77.npy", ".writing-bundle"}
    workshop.prune("remove=true")
    assert not [path for path in [*remains, draft.parent] if path.exists()]
    assert (newest / "checkpoints/last.ckpt").is_file()
