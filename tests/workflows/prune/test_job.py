"""make prune on real trainings and a real store: what is shown, what stays, what goes."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from pathlib import Path

import pytest
from prune_workshop import Workshop

from attentionvote.command.errors import ConfigurationError
from attentionvote.data.sensing import CloudSettings
from attentionvote.files import locked_folder
from attentionvote.simulation.sensor import Sensor
from attentionvote.tracking.store import connect, resolve_store

DAY_S = 86_400


def names(folder: str) -> set[str]:
    return {path.name for path in Path(folder).iterdir() if not path.name.startswith(".")}


def age(folder: Path, days: float) -> None:
    """Make a folder as if it was written so many days ago."""
    when = time.time() - days * DAY_S
    for path in [*folder.rglob("*"), folder]:
        os.utime(path, (when, when))


def test_what_nobody_refers_to_is_shown_and_nothing_is_removed(
    workshop: Workshop, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    before = workshop.tree()
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        answer = workshop.prune()
    assert workshop.tree() == before
    assert (answer["stage"], answer["removed"], answer["unjudged"], answer["unfinished"]) == ("prune", False, [], [])
    by_kind = {kind: [t for t in answer["unreferenced"] if t["kind"] == kind] for kind in ("training", "scenes")}
    assert {Path(t["path"]) for t in by_kind["training"]} == {
        Path("outputs/train/brick") / workshop.training(name).name for name in ("oldest", "middle")
    }
    assert sorted(Path(t["path"]).name.partition("-")[0] for t in by_kind["scenes"]) == ["test", "train", "val"]
    assert len([t for t in answer["unreferenced"] if t["kind"] == "clouds"]) == 3
    # The checkpoints of what stays are told apart: they are not counted.
    assert [Path(t["path"]).parts[-2:] for t in answer["unreferenced"] if t["kind"] == "checkpoints"] == [
        (workshop.training("newest").name, "checkpoints")
    ]
    counted = [Path(t["path"]) for t in answer["unreferenced"] if t["kind"] != "checkpoints"]
    sizes = [size for file, size in before.items() if any(Path(file).is_relative_to(path) for path in counted)]
    assert answer["bytes"] == sum(sizes) > 100_000
    assert "make prune ARGS=remove=true removes them" in caplog.text
    cells = [line.split() for line in capsys.readouterr().err.splitlines()]
    sums = {line[0]: line[1] for line in cells if len(line) == 6 and line[1].isdigit()}
    assert sums == {"training": "2", "checkpoints": "1", "clouds": "3", "scenes": "3", "total": "9"}


def test_what_is_removed_is_gone_and_the_newest_training_is_whole(workshop: Workshop) -> None:
    shown = workshop.prune()
    answer = workshop.prune("remove=true")
    assert answer["removed"]
    assert answer["bytes"] == shown["bytes"]
    assert all(thing["removed"] == (thing["kind"] != "checkpoints") for thing in answer["unreferenced"])
    assert names("outputs/train/brick") == {workshop.training("newest").name}
    assert (len(names("data/scenes/brick")), len(names("data/clouds/brick"))) == (3, 3)
    assert not list(Path.cwd().rglob(".removed-*"))
    assert workshop.train() == workshop.answers["newest"]
    again = workshop.prune("remove=true")
    assert (again["bytes"], {t["kind"] for t in again["unreferenced"]}) == (0, {"checkpoints"})
    # What was removed is trained anew by its command, with the same figures.
    assert workshop.train("simulation.seed=7")["metrics"] == workshop.answers["oldest"]["metrics"]


@pytest.mark.parametrize("by", ["version", "bundle", "sweep"])
def test_a_training_that_is_referred_to_stays_with_its_data(workshop: Workshop, export_brick, by: str) -> None:
    oldest, run_id = workshop.training("oldest"), workshop.run_id("oldest")
    if by == "version":
        client = connect(resolve_store("mlflow.db"))
        client.create_registered_model("attentionvote-brick")
        client.create_model_version("attentionvote-brick", f"runs:/{run_id}/checkpoints", run_id=run_id)
    elif by == "bundle":
        export_brick("latest", run_id)
    else:
        table = workshop.folder / "outputs/sweep/brick/brick-compact-0/trials.json"
        table.parent.mkdir(parents=True)
        table.write_text(json.dumps([{"trial": 0, "directory": f"outputs/train/brick/{oldest.name}", "run_id": None}]))
    workshop.prune("remove=true")
    assert names("outputs/train/brick") == {oldest.name, workshop.training("newest").name}
    assert (len(names("data/scenes/brick")), len(names("data/clouds/brick"))) == (6, 6)


def test_bundles_that_are_neither_latest_nor_registered_nor_shown_go(workshop: Workshop, export_brick) -> None:
    run_id = workshop.run_id("oldest")
    nobodys, registered, on_board = (export_brick(name, run_id) for name in ("a", "b", "c"))
    export_brick("latest", workshop.run_id("newest"))
    client = connect(resolve_store("mlflow.db"))
    client.create_registered_model("attentionvote-brick")
    client.create_model_version("attentionvote-brick", "file:///x", tags={"bundle.digest": registered.digest})
    board = Path("outputs/fleet/leaderboard.json")
    board.parent.mkdir()
    board.write_text(json.dumps({"members": [{"object": "brick", "bundle": on_board.digest, "champion": None}]}))
    record = Path("outputs/export/brick/export-0.json")
    record.write_text(json.dumps({"bundle": f"outputs/export/brick/{nobodys.path.name}"}))
    assert workshop.paths("bundle") == {nobodys.path.name}
    workshop.prune("remove=true")
    assert not nobodys.path.exists()
    assert not record.exists()  # it would say that the export is done
    assert registered.path.is_dir()
    assert on_board.path.is_dir()
    # The two that stay are of this training.
    assert workshop.training("oldest").is_dir()


def test_a_bundle_that_goes_holds_no_training(workshop: Workshop, export_brick) -> None:
    export_brick("nobodys", workshop.run_id("oldest"))
    export_brick("latest", workshop.run_id("newest"))
    assert workshop.training("oldest").name in workshop.paths("training")


def test_unfinished_trainings_stay_and_old_ones_are_listed(workshop: Workshop) -> None:
    oldest = workshop.training("oldest")
    for name in ("result.json", "model.ckpt"):
        (oldest / name).unlink()
    assert workshop.prune()["unfinished"] == []
    age(oldest, 31)
    answer = workshop.prune("remove=true")
    (listed,) = answer["unfinished"]
    assert (Path(listed["path"]).name, listed["age_days"], listed["removed"]) == (oldest.name, 31.0, False)
    assert oldest.is_dir()
    assert len(names("data/scenes/brick")) == 6


def test_a_training_that_has_not_said_what_it_needs_keeps_the_data_while_it_is_young(workshop: Workshop) -> None:
    begun = Path("outputs/train/brick/0123456789ab")
    with locked_folder(begun, "outputs", "training"):
        pass
    answer = workshop.prune()
    assert [t["kind"] for t in answer["unreferenced"] if t["kind"] in ("scenes", "clouds")] == []
    assert answer["unjudged"] == [
        f"scenes and clouds of brick are kept, because {begun} does not say which it needs"
    ]  # fmt: skip
    age(begun, 31)
    assert len(workshop.paths("scenes")) == 3


def test_interrupted_scenes_and_clouds_stay_while_they_are_young(workshop: Workshop) -> None:
    for kind, name, remove in (("scenes", "train-0", ["manifest.json"]), ("clouds", "0" * 16, ["count.npy"])):
        folder = Path("data", kind, "brick")
        shutil.copytree(sorted(path for path in folder.iterdir())[0], folder / name)
        for file in remove:
            (folder / name / file).unlink()
    assert workshop.paths("scenes") & {"train-0"} == workshop.paths("clouds") & {"0" * 16} == set()
    for path in (Path("data/scenes/brick/train-0"), Path("data/clouds/brick") / ("0" * 16)):
        age(path, 31)
    assert "train-0" in workshop.paths("scenes")
    assert "0" * 16 in workshop.paths("clouds")


def test_what_a_process_is_at_stays_and_so_do_the_data_of_its_part(workshop: Workshop) -> None:
    with locked_folder(workshop.training("oldest"), "outputs", "training"):
        answer = workshop.prune("remove=true")
    assert workshop.training("oldest").is_dir()
    assert not workshop.training("middle").exists()
    assert len(names("data/scenes/brick")) == 6
    (sentence,) = answer["unjudged"]
    assert sentence.startswith("scenes and clouds of brick are kept, because a process is at outputs/train/brick/")


@pytest.mark.parametrize(
    ("store", "reason"),
    [
        ("http://127.0.0.1:9", "tracking server http://127.0.0.1:9 must answer, got: "),
        ("away.db", "away.db must be there, but it is not: name it with tracking.store"),
    ],
)
def test_a_store_that_does_not_answer_keeps_everything(workshop: Workshop, store: str, reason: str) -> None:
    answer = workshop.prune("remove=true", f"tracking.store={store}")
    (sentence,) = answer["unjudged"]
    assert sentence.startswith("bundles, trainings and data of brick are kept, because ")
    assert reason in sentence
    assert (answer["bytes"], {t["kind"] for t in answer["unreferenced"]}) == (0, {"checkpoints"})
    assert len(names("outputs/train/brick")) == 3
    assert not Path("away.db").exists()


def test_a_store_that_does_not_have_the_runs_is_another_one(workshop: Workshop, export_brick, put_tables) -> None:
    bundle = export_brick("a", workshop.run_id("oldest"))
    export_brick("latest", workshop.run_id("newest"))
    put_tables(Path("other.db"))
    answer = workshop.prune("remove=true", "tracking.store=other.db")
    assert answer["bytes"] == 0
    assert bundle.path.is_dir()
    assert [sentence.partition(" of brick")[0].split()[0] for sentence in answer["unjudged"]] == [
        "bundles",
        "trainings",
    ]
    assert len(names("outputs/train/brick")) == 3


def test_without_its_checkpoints_more_epochs_begin_anew(
    workshop: Workshop, caplog: pytest.LogCaptureFixture
) -> None:  # fmt: skip
    newest = workshop.training("newest")
    workshop.prune("remove=true", "checkpoints=true")
    assert not (newest / "checkpoints").exists()
    assert workshop.train() == workshop.answers["newest"]
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        assert workshop.train("trainer.max_epochs=2")["steps"] == 4
    assert "trained anew, because the checkpoints of outputs/train/brick/" in caplog.text
    assert "going on after the last epoch" not in caplog.text


def test_folders_elsewhere_refer_to_data_and_stay(workshop: Workshop) -> None:
    shutil.copytree(workshop.training("oldest"), "elsewhere/train/brick/" + workshop.training("oldest").name)
    assert len(workshop.paths("scenes")) == 3
    assert workshop.paths("scenes", "also=[elsewhere]") == set()
    Path("outputs/train").rename("disk")
    Path("outputs/train").symlink_to(Path("disk").absolute())
    assert len(workshop.paths("scenes")) == 3
    for wrong in ("outputs=outptus", "also=[nowhere]"):
        with pytest.raises(ConfigurationError, match=r"must name a folder with results, got '\w+', which is none$"):
            workshop.prune(wrong)


@pytest.fixture
def evaluation_set(workshop: Workshop) -> tuple[Path, str]:
    """A scene set that no training has, and its digest."""
    original = next(Path("data/scenes/brick").glob("test-*"))
    folder, digest = original.with_name("evaluation-0"), "e" * 64
    shutil.copytree(original, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, "content_digest": digest}))
    assert "evaluation-0" in workshop.paths("scenes")
    return folder, digest


@pytest.mark.parametrize("known_by", ["scenes", "default sensor", "version"])
def test_an_evaluation_refers_to_its_scenes(
    workshop: Workshop, evaluation_set: tuple[Path, str], known_by: str
) -> None:
    folder, digest = evaluation_set
    key = CloudSettings(Sensor("gaussian", sigma_mm=0.3), density=40_000, pool=40_000).key(digest)
    result = {"object": "brick", "evaluation_set": "f" * 64, "sensor": "gaussian", "scene_set": digest}
    if known_by == "version":
        client = connect(resolve_store("mlflow.db"))
        client.create_registered_model("attentionvote-brick")
        client.create_model_version("attentionvote-brick", "file:///x", tags={"evaluation.set": key})
    else:
        if known_by == "default sensor":
            result = {"object": "brick", "evaluation_set": key, "sensor": "gaussian"}
        path = Path("outputs/evaluate/brick/a-b-1.json")
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(result))
    answer = workshop.prune("remove=true")
    assert folder.is_dir()
    assert answer["unjudged"] == []


def test_an_evaluation_with_another_sensor_keeps_all_sets(workshop: Workshop, evaluation_set: tuple[Path, str]) -> None:
    path = Path("outputs/evaluate/brick/a-b-1.json")
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"object": "brick", "evaluation_set": "f" * 64, "sensor": "phoxi"}))
    answer = workshop.prune("remove=true")
    assert evaluation_set[0].is_dir()
    (sentence,) = answer["unjudged"]
    assert sentence.startswith("evaluation sets of brick are kept, because an evaluation names ffffffffffff, ")
    assert len(names("data/scenes/brick")) == 4  # those of trainings are judged all the same
