"""What a training takes from a folder: the dataset's own splits, else whole drop cycles, and who is refused."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from written_piles import pile_records, write_piles

from attentionvote.data.dataset_splits import DatasetSplits
from attentionvote.data.sensing import CloudSettings
from attentionvote.export import held_out
from attentionvote.part import Part
from attentionvote.simulation.sensor import Sensor

SHARES = {"val": 0.2, "test": 0.4}


@pytest.fixture(scope="module")
def training(box: Part, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five cycles in two parts of one object, as the public dataset is stored."""
    folder = tmp_path_factory.mktemp("data") / "training"
    write_piles(folder / "box_part_1", box, pile_records(box, 3, (5,)))
    write_piles(folder / "box_part_2", box, pile_records(box, 2, (5, 6), first=3))
    return folder


def cycles(opened: DatasetSplits) -> dict[str, list[str]]:
    return {split: list(scenes.cycles) for split, scenes in opened.splits.items()}


def test_whole_cycles_from_the_end_are_held_out(training: Path, box: Part) -> None:
    opened = DatasetSplits.open(training, box, SHARES)
    assert cycles(opened) == {
        "train": ["cycle_0000", "cycle_0001"],
        "val": ["cycle_0002"],
        "test": ["cycle_0003", "cycle_0004"],
    }
    assert str(opened) == (
        "train: box train, 2 drop cycles (cycle_0000 to cycle_0001); val: box train, 1 drop cycle (cycle_0002); "
        "test: box train, 2 drop cycles (cycle_0003 to cycle_0004)"
    )
    assert [len(scenes) for scenes in opened.splits.values()] == [2, 1, 4]
    assert opened.evidence == {"cycles": "".join(opened.splits[s].fingerprint for s in ("train", "val"))}
    assert len(opened.evidence["cycles"]) == 3 * 8
    kept = opened.described()
    assert kept["folder"] == str(training)
    assert kept["splits"]["test"]["scenes"] == 4
    # A share that makes less than one cycle makes one.
    least = DatasetSplits.open(training, box, {"val": 0.01, "test": 0.01})
    assert [len(names) for names in cycles(least).values()] == [3, 1, 1]


def test_own_splits_are_taken(training: Path, box: Part, tmp_path: Path) -> None:
    shutil.copytree(training, tmp_path / "training")
    write_piles(tmp_path / "testing" / "box", box, pile_records(box, 2, (5,), first=10))
    write_piles(tmp_path / "testing" / "screw", box, pile_records(box, 1, (5,), first=20))  # another object
    opened = DatasetSplits.open(tmp_path, box, SHARES)
    assert cycles(opened) == {
        "train": ["cycle_0000", "cycle_0001", "cycle_0002", "cycle_0003"],
        "val": ["cycle_0004"],
        "test": ["cycle_0010", "cycle_0011"],
    }
    assert opened.origins["test"] == "box test, all"
    write_piles(tmp_path / "validation" / "box", box, pile_records(box, 1, (5,), first=30))
    opened = DatasetSplits.open(tmp_path, box, SHARES)
    assert cycles(opened)["val"] == ["cycle_0030"]
    assert len(opened.splits["train"].cycles) == 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda part: replace(part, vertices=part.vertices + np.array([0.01, 0, 0])),
            r"box must have the frame .* got \d.*mm",
        ),
        (lambda part: replace(part, vertices=part.vertices * 1000), "box must have the frame of the poses"),
    ],
)
def test_a_part_in_another_frame_is_refused(
    training: Path, box: Part, tmp_path: Path, change: Callable[[Part], Part], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        DatasetSplits.open(training, change(box), SHARES)
    shutil.copytree(training, tmp_path / "training")
    for labels in tmp_path.rglob("p_segmentation"):
        shutil.rmtree(labels)
    DatasetSplits.open(tmp_path, box, SHARES)  # the same without labels
    with pytest.raises(ValueError, match=r"box must have the frame of .*80 % of a scene's points on.*got \d+ %"):
        DatasetSplits.open(tmp_path, change(box), SHARES)


def test_what_cannot_be_split_is_refused(training: Path, box: Part, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"more than 4 drop cycles to hold out .* val and test, got 3: lower data.held"
    ):
        DatasetSplits.open(training / "box_part_1", box, {"val": 0.4, "test": 0.9})
    shutil.copytree(training, tmp_path / "training")
    for place in ("training/one", "training/two"):
        write_piles(tmp_path / place, box, pile_records(box, 1, (5,)))
    other = replace(box, name="two parts")
    with pytest.raises(ValueError, match=r"a dataset of one part, two parts, .*got box train, one train, two train"):
        DatasetSplits.open(tmp_path, other, SHARES)
    shutil.copytree(training, tmp_path / "more" / "train_too")
    with pytest.raises(ValueError, match="one dataset to train on and at most one for val and for test, got box train"):
        DatasetSplits.open(tmp_path, box, SHARES)
    few = write_piles(tmp_path / "few" / "training" / "box", box, pile_records(box, 3, (4,)))
    with pytest.raises(ValueError, match="must hold scenes with at least five parts, got 6 others"):
        DatasetSplits.open(few, box, SHARES)


def test_several_parts_are_refused(box: Part, tmp_path: Path) -> None:
    write_piles(tmp_path / "both" / "train", box, pile_records(box, 1, (5,)), "bop")
    info = tmp_path / "both" / "models" / "models_info.json"
    one = info.read_text()
    info.write_text(one.rstrip().removesuffix("}") + ', "2": ' + one.strip().partition(":")[2])
    with pytest.raises(ValueError, match=re.escape("of the parts obj_000001, obj_000002: name the folder of one")):
        DatasetSplits.open(tmp_path, box, SHARES)


def test_an_export_finds_the_test_scenes_again(training: Path, box: Part, tmp_path: Path) -> None:
    place = tmp_path / "training"
    shutil.copytree(training, place)
    opened = DatasetSplits.open(place, box, SHARES)
    metadata: dict[str, Any] = {
        "part": {"digest": box.digest},
        "data": {"test": opened.splits["test"].digest},
        "dataset": opened.described(),
        "clouds": {"sensor": {"preset": "none"}, "density": 900, "pool": 400, "neighbors": 12},
    }
    scenes = held_out.find_test_scenes(metadata, box, tmp_path)
    settings = CloudSettings.of(metadata["clouds"])
    assert settings.sensor == Sensor("none")
    clouds = held_out.measured(scenes, box, settings, tmp_path, 1)
    whole = dict(held_out.whole_clouds(scenes, box, settings, [0, 3]))
    assert {name: len(points) for name, points in whole.items()} == {
        "scene_cycle_0003_005": 900,
        "scene_cycle_0004_006": 900,
    }
    stored = {tuple(point) for point in clouds[3].points.tolist()}
    assert stored < {tuple(point) for point in whole["scene_cycle_0004_006"].tolist()}
    assert not np.array_equal(*whole.values())
    (place / "box_part_2" / "gt" / "cycle_0004" / "006.csv").write_text("")
    with pytest.raises(
        ValueError, match=r"must hold the test scenes \w{12} that the network .*changed, train it again"
    ):
        held_out.find_test_scenes(metadata, box, tmp_path)
    shutil.rmtree(place)
    with pytest.raises(ValueError, match=r"must be where it was: .*training: the folder of a dataset must exist"):
        held_out.find_test_scenes(metadata, box, tmp_path)
