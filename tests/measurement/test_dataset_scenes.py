"""Scenes of a dataset in the IPA layout: measured on like our own, and refused when the part is not theirs."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import evaluate
import numpy as np
import pytest
import write_data

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError
from attentionvote.data.dataset_split import DatasetSplit
from attentionvote.measurement.dataset_scenes import DatasetScenes
from attentionvote.workflows.evaluate.job import EvaluationJob
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.settings import WriteDataSettings

WRITTEN = ["object=brick", "simulation=smoke", "simulation.drop_counts=[2,5]", "split=test", "workers=1"]


@pytest.fixture(scope="module")
def ipa(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pile of two and one of five bricks, written as the public dataset is."""
    place = tmp_path_factory.mktemp("ipa")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        written = write_data.run(compose(WriteDataSettings, [*WRITTEN, f"directory={place}", f"root={place}/scenes"]))
    return Path(written["directory"])


@pytest.fixture
def brick() -> Any:
    """The part."""
    return compose(EvaluateSettings, ["object=brick"]).object()


def test_scored_scenes_come_without_background_and_thinned(ipa: Path, brick: Any) -> None:
    scenes = DatasetScenes.find(ipa, brick, 1000)
    assert len(scenes) == 1  # fewer than five drops are not scored
    assert list(scenes.cycle_of_scene) == [0]
    (cloud,), (again,) = list(scenes.clouds()), list(scenes.clouds())
    assert len(cloud.points) == 1000
    assert (cloud.instance_ids >= 0).all()
    assert cloud.camera_from_part.shape == (5, 4, 4)
    np.testing.assert_array_equal(cloud.points, again.points)
    other = DatasetScenes.find(ipa, brick, 999)
    assert scenes.digest == DatasetScenes.find(ipa, brick, 1000).digest != other.digest


@pytest.mark.parametrize("frame", ["moved", "turned"])
def test_a_part_in_another_frame_is_refused(ipa: Path, brick: Any, frame: str) -> None:
    vertices = brick.vertices + np.array([0.006, 0, 0]) if frame == "moved" else brick.vertices[:, [1, 2, 0]]
    moved = replace(brick, vertices=vertices)
    with pytest.raises(ValueError, match=r"brick must have the frame of the poses .*got \d\.\d mm: use the dataset's"):
        DatasetScenes.find(ipa, moved, 4000)


def test_a_folder_without_data_is_refused(tmp_path: Path, brick: Any) -> None:
    with pytest.raises(ValueError, match=str(tmp_path)):
        DatasetScenes.find(tmp_path, brick, 1000)


def test_evaluate_measures_on_a_dataset(ipa: Path, export_brick: Any) -> None:
    bundle = export_brick("model")
    words = ["object=brick", f"evaluation.dataset={ipa}", "evaluation.density=2000"]
    result = evaluate.run(compose(EvaluateSettings, words))
    assert (result["bundle"], result["scenes"], result["sensor"]) == (bundle.digest, 1, "brick test")
    assert result["frozen"] is None
    assert 0 <= result["figures"]["ap_10"] <= 1
    with pytest.raises(ConfigurationError):
        evaluate.run(compose(EvaluateSettings, [*words[:1], "evaluation.dataset=/nowhere"]))


def test_scenes_that_the_model_learned_from_are_refused(ipa: Path, brick: Any, export_brick: Any) -> None:
    export_brick("model")
    job = EvaluationJob.find(compose(EvaluateSettings, ["object=brick", f"evaluation.dataset={ipa}"]))
    dataset = DatasetScenes.find(ipa, brick, 1000).dataset
    learned = DatasetSplit(dataset, dataset.scored_names, brick)
    assert len(job.evaluation_set()) == 1
    for data, refused in (
        ({"train": learned.digest, "cycles": "0" * 8 + learned.fingerprint}, True),
        ({"train": str(dataset.written_from)}, True),  # trained with the generated scenes themselves
        ({"test": learned.digest, "cycles": "0" * 16}, False),  # a training's test decides nothing
    ):
        card = replace(job.bundle.card, data=data)
        trained = replace(job, bundle=replace(job.bundle, card=card))
        message = "the model was not trained with, but it was with 1 of the 1 drop cycles, cycle_0000 for one"
        with pytest.raises(ValueError, match=message) if refused else nullcontext():
            trained.evaluation_set()
