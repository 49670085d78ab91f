"""The verbs write_data and check_data together: a generated set becomes a dataset that the check finds sound."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import check_data
import numpy as np
import pytest
import write_data

from attentionvote.command.configuration import compose
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.datasets import open_datasets
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.workflows.settings import CheckDataSettings, WriteDataSettings

TINY = ["object=brick", "simulation=smoke", "simulation.cycles.test=1", "simulation.drop_counts=[2,5]", "workers=1"]
TINY += [f"simulation.camera.camera.{key}" for key in ("width=344", "height=257", "fx=567.0", "fy=567.0")]
TINY += ["simulation.camera.camera.cx=172.0", "simulation.camera.camera.cy=128.0"]
STILL = [f"simulation.camera.{key}=0.0" for key in ("distance_jitter", "shift", "tilt_degrees", "roll_degrees")]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the scene sets of the module are."""
    return tmp_path_factory.mktemp("scenes")


def write(root: Path, target: Path, *words: str) -> dict[str, Any]:
    return write_data.run(compose(WriteDataSettings, [*TINY, f"root={root}", f"directory={target}", *words]))


def check(directory: Path, *words: str) -> dict[str, Any]:
    return check_data.run(compose(CheckDataSettings, [f"directory={directory}", *words]))


def records(root: Path) -> list[Any]:
    return list(next(SceneSet.open(path) for path in sorted((root / "brick").iterdir())))


@pytest.mark.parametrize("still", [False, True])
def test_ipa_data_of_a_generated_set_is_sound(root: Path, tmp_path: Path, still: bool) -> None:
    scenes = root / ("still" if still else "moving")
    result = write(scenes, tmp_path, *(STILL if still else []))
    folder = tmp_path / "ipa" / "testing" / "brick"
    assert (result["directory"], result["scenes"]) == (str(folder), 2)
    checked = check(tmp_path)
    (found,) = checked["datasets"]
    assert (found["format"], found["split"], found["scenes"], found["with_five_drops"]) == ("ipa", "test", 3, 1)
    assert (found["instances"], found["poses_off_their_points"], checked["errors"]) == (7, 0, [])
    assert found["poses_looked_at"] >= 6
    (dataset,) = open_datasets(folder)
    first = records(scenes)[1]  # five bricks
    frame = dataset.frame("cycle_0000/005")
    np.testing.assert_allclose(frame.ground_truth.camera_from_part, first.camera_from_part, atol=1e-9)
    np.testing.assert_allclose(frame.ground_truth.visible_fraction, first.visible_fraction, atol=1e-12)
    # With a camera that stands still the bin is in the picture, and the empty bin's picture takes it away again.
    assert (np.isfinite(frame.depth).sum() > 2 * (frame.instance >= 0).sum()) is np.bool_(still)
    scene = dataset.scene("cycle_0000/005")
    assert len(scene.points) == (frame.instance >= 0).sum() > 300
    half = np.ptp(np.asarray(first_part_vertices()), axis=0) / 2
    for row, pose in enumerate(scene.camera_from_part):
        local = (scene.points[scene.instance_ids == row] - pose[:3, 3]) @ pose[:3, :3]
        assert (np.abs(local) <= half + 2e-5).all()
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert write(scenes, tmp_path, *(STILL if still else []))["scene_set"] == result["scene_set"]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()} == before
    with pytest.raises(ConfigurationError, match=r"directory must not hold other data, but .*testing/brick is there"):
        write(scenes, tmp_path, *(STILL if still else []), "scenes=1")
    assert not list(tmp_path.rglob(".*"))


def first_part_vertices() -> Any:
    from attentionvote.simulation.part_files import load_part

    return load_part("brick", "builtin:brick").vertices


def test_bop_data_of_a_generated_set_is_sound(root: Path, tmp_path: Path) -> None:
    result = write(root / "moving", tmp_path, "format=bop")
    assert result["directory"] == str(tmp_path / "bop" / "brick" / "test")
    checked = check(tmp_path / "bop")
    (found,) = checked["datasets"]
    assert (found["format"], found["title"], found["scenes"], found["instances"]) == ("bop", "brick", 2, 7)
    assert (found["poses_off_their_points"], checked["errors"], found["warnings"]) == (0, [], [])
    (dataset,) = open_datasets(tmp_path)
    frame = dataset.frame("000000/000001")
    first = records(root / "moving")[1]
    np.testing.assert_allclose(frame.ground_truth.camera_from_part, first.camera_from_part, atol=1e-9)
    assert (frame.camera.fx, frame.camera.cx) == (567.0, 172.0)
    info = json.loads((tmp_path / "bop" / "brick" / "models" / "models_info.json").read_text())
    assert len(info["1"]["symmetries_discrete"]) == 1  # C2
    gt_info = json.loads((tmp_path / "bop" / "brick" / "test" / "000000" / "scene_gt_info.json").read_text())
    shares = [e["px_count_visib"] / e["px_count_all"] for e in gt_info["1"]]
    np.testing.assert_allclose(shares, first.visible_fraction, atol=0.08)  # visibility is of every fourth pixel
    (tmp_path / "bop" / "brick" / "models" / "models_info.json").write_text("{}")
    with pytest.raises(ConfigurationError, match="directory must not hold models of other parts"):
        write(root / "moving", tmp_path, "format=bop", "split=val")
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("format=coco", "format must be one of ipa, bop; got 'coco'"),
        ("split=tset", "split must be one of train, val, test; got 'tset', did you mean 'test'"),
        ("simulation.camera.camera.fy=600.0", "one focal length, got fx 567.0 and fy 600.0"),
        ("simulation.camera.camera.cy=128.5", "cx and cy both at whole or both at half pixels, got 172.0 and 128.5"),
        ("object=industrial", "object must be one part for format=ipa, got industrial"),
    ],
)
def test_what_cannot_be_written_is_said_before_any_work(tmp_path: Path, word: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        write(tmp_path / "scenes", tmp_path / "out", word)
    assert not list(tmp_path.iterdir())


def test_the_check_refuses_what_is_wrong_and_what_is_no_dataset(
    root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    write(root / "moving", tmp_path / "data")
    for path in (tmp_path / "data").rglob("005_segmentation.png"):
        path.unlink()
    with pytest.raises(Refused, match=r"brick, test: 1 of 3 scenes lack its image of labels") as refused:
        check(tmp_path / "data")
    assert refused.value.result["errors"] == refused.value.result["datasets"][0]["errors"]
    shown = capfd.readouterr()
    assert shown.out == ""
    # brick is one of the paper's objects, but this set is not the paper's: nothing is expected.
    assert re.search(r"ipa\s+brick\s+test\s+3\s+1\s+-\s+2\s+7\s+0\s+1", shown.err), shown.err
    assert "scenes lack its image of labels" in caplog.text
    with pytest.raises(ConfigurationError, match=r"must hold a dataset of a known layout, got none of them .IPA:"):
        check(root)
    with pytest.raises(ConfigurationError, match=r"directory must be given, e\.g\. directory=data/ipa"):
        check_data.run(compose(CheckDataSettings, []))
    for name in ("scene_camera.json", "scene_gt.json"):
        (tmp_path / name).write_text("{")
    with pytest.raises(Refused, match=r"scene_camera.json: the file must be JSON"):
        check(tmp_path)
