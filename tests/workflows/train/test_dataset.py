"""The verb train on the scenes of a dataset: recorded everywhere, and never measured on again."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import pytest
import train
from tiny_training import TINY_TRAINING
from written_piles import pile_records, write_piles

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.data.clouds import Clouds
from attentionvote.data.sensing import CloudSettings
from attentionvote.measurement.dataset_scenes import DatasetScenes
from attentionvote.part import Part
from attentionvote.simulation.part_files import load_part
from attentionvote.simulation.sensor import Sensor
from attentionvote.training.checkpoint import load_trained
from attentionvote.workflows.fleet import board as fleet_board
from attentionvote.workflows.train.job import find_training
from attentionvote.workflows.train.settings import TrainSettings
from attentionvote.workflows.train.tracking import DATASET

TINY = [
    "object=brick", *TINY_TRAINING, "workers=1", "force=false", "trainer.batch_size=2", "trainer.max_epochs=2",
    "trainer.average_decay=0.0",
]  # fmt: skip
pytestmark = pytest.mark.usefixtures("quick_training")


@pytest.fixture(scope="module")
def brick() -> Part:
    return load_part("brick", "builtin:brick", diameter=compose(TrainSettings, TINY).object.arguments["diameter"])


@pytest.fixture(scope="module")
def data(brick: Part, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """IPA: four cycles of training and two of test; BOP: the same training scenes."""
    folder = tmp_path_factory.mktemp("data")
    records = pile_records(brick, 4, (3, 5, 6))
    write_piles(folder / "ipa" / "training" / "brick", brick, records)
    write_piles(folder / "ipa" / "testing" / "brick", brick, pile_records(brick, 2, (5,), first=9))
    write_piles(folder / "bop" / "brick" / "train", brick, records, "bop")
    return folder


@pytest.fixture
def words(store: str, tmp_path: Path) -> list[str]:
    return [*TINY, f"root={tmp_path}/root", f"outputs={tmp_path}/out", f"tracking.store={store}"]


def run(words: list[str], *more: str) -> dict[str, Any]:
    return json.loads(json.dumps(train.run(compose(TrainSettings, [*words, *more]))))


def test_a_training_on_held_out_cycles_is_recorded(
    data: Path, brick: Part, words: list[str], store: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = [*words, f"data.dataset={data}/ipa/training/brick"]
    with caplog.at_level(logging.INFO, logger="attentionvote"):
        result = run(said)
    assert (
        f"scenes of {data}/ipa/training/brick: train: brick train, 2 drop cycles (cycle_0000 to cycle_0001); "
        "val: brick train, 1 drop cycle (cycle_0002); test: brick train, 1 drop cycle (cycle_0003)"
    ) in caplog.text
    assert "brick: 4/2/2 scenes (train/val/test)" in caplog.text
    assert (result["steps"], result["test_scenes"]) == (4, 2)
    _, metadata = load_trained(result["model"])
    job = find_training(compose(TrainSettings, said))
    assert job.dataset is not None
    digests = {split: scenes.digest for split, scenes in job.dataset.splits.items()}
    assert metadata["data"] == digests | job.dataset.evidence
    assert metadata["dataset"]["folder"] == f"{data}/ipa/training/brick"
    place = Path(store).parent / "mlartifacts" / result["run_id"] / "artifacts"
    assert json.loads((place / DATASET).read_text()) == metadata["dataset"]
    assert not (tmp_path / "root" / "scenes").exists()  # nothing was generated
    # Done, also where the same data have been moved to.
    moved = shutil.copytree(data / "ipa" / "training", tmp_path / "moved")
    assert run(words, f"data.dataset={moved}") == result
    # What it learned from is never measured on; scenes that it has not seen are.
    for folder in (data / "ipa" / "training" / "brick", moved):
        with pytest.raises(ValueError, match=r"was with 3 of the 4 drop cycles, cycle_0000 for one: name the folder"):
            DatasetScenes.find(folder, brick, 1000).check_unseen(metadata["data"])
    shutil.rmtree(moved / "brick" / "gt" / "cycle_0002")
    DatasetScenes.find(data / "ipa" / "testing", brick, 1000).check_unseen(metadata["data"])
    assert fleet_board.stale_splits(metadata["data"], job, tmp_path) == []
    assert fleet_board.stale_splits({"train": "another"}, job, tmp_path) == ["train", "val", "test"]


def test_bop_and_own_splits_are_trained_on(data: Path, words: list[str], tmp_path: Path) -> None:
    plain, held, bop, own = (
        find_training(compose(TrainSettings, [*words, word]))
        for word in ("seed=0", "data.held_out.val=0.1", f"data.dataset={data}/bop", f"data.dataset={data}/ipa")
    )
    assert plain.dataset is None
    assert plain.directory == held.directory  # what means nothing without a dataset makes no other training
    assert bop.scene_counts == {"train": 4, "val": 2, "test": 2}
    assert own.scene_counts == {"train": 6, "val": 2, "test": 2}
    assert len({job.directory for job in (plain, bop, own)}) == 3
    result = run(words, f"data.dataset={data}/bop", "data.sensor.preset=none")
    assert result["steps"] == 4
    assert bop.dataset is not None
    settings = CloudSettings(Sensor("none"), 1500, 800, compose(TrainSettings, words).data.normal_neighbors)
    key = settings.key(bop.dataset.splits["train"].digest)[:16]
    clouds = Clouds(tmp_path / "root" / "clouds" / "brick" / key, bop.dataset.splits["train"])
    assert [clouds.count(i) for i in range(4)] == [800] * 4
    assert (clouds[0].instance_ids >= 0).all()  # the labels leave the bin out


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["data.sensor.preset=phoxi"], "data.sensor.preset must be gaussian or none with data.dataset"),
        (["object=industrial"], "object must be one part for data.dataset, got industrial"),
        (["object=gear"], "gear must have the frame of the poses in .*use the dataset's own mesh"),
        (["trainer.batch_size=5"], "trainer.batch_size must be at most the 4 training scenes, got 5"),
        (["data.dataset=/nowhere"], "/nowhere: the folder of a dataset must exist, got nothing there"),
        (["data.held_out.val=0"], "data.held_out.val must be greater than 0 and at most 0.4; got 0"),
    ],
)
def test_what_cannot_be_trained_on_is_said_before_any_work(
    data: Path, words: list[str], tmp_path: Path, more: list[str], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run([*words, f"data.dataset={data}/ipa/training/brick"], *more)
    assert not (tmp_path / "root").exists()
