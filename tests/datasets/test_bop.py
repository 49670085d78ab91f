"""The BOP format: written and read back, sensors as suffixes, meshes, what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from attentionvote.datasets import PinholeCamera, open_datasets
from attentionvote.datasets.bop import BopDataset
from attentionvote.datasets.bop_writer import BopSceneWriter, write_models
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part

COUNTS = (0, 2, 5)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, make_pile: Callable[..., Any], box: Part) -> Path:
    """``boxes/`` with models (obj 1 and 4) and ``test/000003`` of 0, 2 and 5 boxes."""
    root = tmp_path_factory.mktemp("bop") / "boxes"
    write_models(root / "models", {1: box, 4: box})
    writer = BopSceneWriter(root / "test" / "000003")
    for image, count in enumerate(COUNTS):
        pile = make_pile(count)
        writer.write(image, pile.pinhole, *pile[1:6], [4, 1, 4, 4, 1][:count])
    assert not (root / "test" / "000003" / "scene_camera.json").exists()
    writer.finish()
    return root


def test_a_written_scene_is_read_back(written: Path, make_pile: Callable[..., Any]) -> None:
    (dataset,) = open_datasets(written)
    assert (dataset.format, dataset.title, dataset.split) == ("bop", "boxes", "test")
    assert dataset.parts == ("obj_000001", "obj_000004")
    np.testing.assert_allclose(dataset.diameters, [np.sqrt(0.06**2 + 0.04**2 + 0.02**2)] * 2)
    assert dataset.names == ("000003/000000", "000003/000001", "000003/000002")
    assert [dataset.drop_count(name) for name in dataset.names] == list(COUNTS)
    assert dataset.scored_names == ("000003/000002",)
    assert dataset.missing_files() == {"depth": [], "gt": [], "labels": []}
    pile = make_pile(5)
    frame = dataset.frame("000003/000002")
    assert frame.camera == pile.pinhole
    seen = np.isfinite(pile.depth)
    np.testing.assert_array_equal(np.isfinite(frame.depth), seen)
    assert np.abs(frame.depth - pile.depth)[seen].max() <= 0.0100001 / 1000  # half of 0.02 mm
    np.testing.assert_array_equal(frame.instance, pile.instance)
    truth = frame.ground_truth
    np.testing.assert_allclose(truth.camera_from_part, pile.camera_from_part, atol=1e-12)
    np.testing.assert_allclose(truth.visible_fraction, pile.visible_fraction, atol=1e-12)
    np.testing.assert_array_equal(truth.part_ids, [1, 0, 1, 1, 0])
    scene = dataset.scene("000003/000002")
    assert len(scene.points) == seen.sum()
    for row in range(5):
        own, exact = scene.points[scene.instance_ids == row], pile.exact_points[pile.instance == row]
        assert len(own) == len(exact)
        distance = np.linalg.norm(own[:, None] - exact[None], axis=-1)
        assert max(distance.min(axis=1).max(), distance.min(axis=0).max()) < 12e-6
    with pytest.raises(ValueError, match=r"000003/000002 cannot be removed, because .*: crop the bin instead"):
        dataset.scene("000003/000002", remove_background=True)


def test_what_the_toolkit_counts_is_counted(written: Path, make_pile: Callable[..., Any]) -> None:
    pile = make_pile(5)
    info = json.loads((written / "test" / "000003" / "scene_gt_info.json").read_text())["2"]
    for row, entry in enumerate(info):
        v, u = np.nonzero(pile.instance == row)
        if len(u):
            assert entry["bbox_visib"] == [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]
        assert entry["px_count_visib"] == len(u)
        assert entry["px_count_all"] >= pile.alone[row].sum() >= entry["px_count_visib"]
    raw = json.loads((written / "test" / "000003" / "scene_gt.json").read_text())["2"][0]
    np.testing.assert_allclose(raw["cam_t_m2c"], pile.camera_from_part[0, :3, 3] * 1000)
    np.testing.assert_allclose(np.reshape(raw["cam_R_m2c"], (3, 3)), pile.camera_from_part[0, :3, :3])
    mask = np.asarray(Image.open(written / "test" / "000003" / "mask" / "000002_000001.png"))
    np.testing.assert_array_equal(mask > 0, pile.alone[1] | (pile.instance == 1))


def test_each_sensor_is_a_dataset_and_masks_stand_in_for_a_missing_info_file(written: Path, tmp_path: Path) -> None:
    scene = tmp_path / "xyzibd" / "val" / "000003"
    shutil.copytree(written / "test" / "000003", scene)
    for sensor in ("photoneo", "xyz"):
        for path in list((written / "test" / "000003").iterdir()):
            target = scene / f"{path.stem}_{sensor}{path.suffix}"
            (shutil.copytree if path.is_dir() else shutil.copy)(path, target)
    for path in (written / "test" / "000003").iterdir():
        (shutil.rmtree if path.is_dir() else Path.unlink)(scene / path.name)
    (scene / "scene_gt_info_photoneo.json").unlink()
    photoneo, xyz = open_datasets(tmp_path)
    assert (photoneo.title, xyz.title, xyz.split) == ("xyzibd (photoneo)", "xyzibd (xyz)", "val")
    assert photoneo.parts == ("obj_000001", "obj_000004")  # from the ground truth, without models
    assert photoneo.diameters == (None, None)
    a, b = photoneo.frame("000003/000002"), xyz.frame("000003/000002")
    np.testing.assert_array_equal(a.instance, b.instance)
    # The whole silhouettes lie in this picture, but for what its border cuts.
    np.testing.assert_allclose(a.ground_truth.visible_fraction, b.ground_truth.visible_fraction, atol=0.02)


def test_a_split_without_ground_truth_still_has_points(written: Path, tmp_path: Path) -> None:
    scene = tmp_path / "boxes" / "test" / "000003"
    shutil.copytree(written / "test" / "000003", scene)
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (scene / name).unlink()
    (dataset,) = open_datasets(tmp_path)
    assert dataset.missing_files()["gt"] == list(dataset.names)
    assert len(dataset.points(dataset.names[2])) > 1000
    with pytest.raises(ValueError, match=r"scene_gt.json: there must be a list of poses for image 2, got none"):
        dataset.scene(dataset.names[2])


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("gt", {"cam_t_m2c": [0.1, 0.02, 0.85]}, "translation of entry 0 must be in millimetres, .*looks like metres"),
        ("gt", {"cam_R_m2c": [2, 0, 0, 0, 1, 0, 0, 0, 1]}, "R of entry 0 must be a rotation"),
        ("gt", {"obj_id": 7}, "an obj_id among 1, 4"),
        ("gt", {"cam_R_m2c": [1, 0, 0]}, "nine numbers R and three numbers t"),
        ("gt_info", {"visib_fract": "most"}, "visib_fract must be a finite number, got 'most'"),
        ("camera", {"depth_scale": 0.00002}, "must be millimetres, got a median of .*: looks like metres"),
        ("camera", {"depth_scale": 20.0}, "must be millimetres, got a median of .*: looks like micrometres"),
        ("camera", {"cam_K": [200, 0, 0, 0, 200, 0, 57, 50, 1]}, "cam_K of image .* row by row fx 0 cx 0 fy cy"),
        ("camera", {"cam_K": [200, 57]}, "cam_K of image 000003/000002 must be nine numbers"),
    ],
)
def test_what_breaks_a_rule_is_one_sentence(
    written: Path, tmp_path: Path, file: str, change: dict[str, Any], message: str
) -> None:
    root = tmp_path / "boxes"
    shutil.copytree(written, root)
    path = root / "test" / "000003" / f"scene_{file}.json"
    content = json.loads(path.read_text())
    (content["2"] if file == "camera" else content["2"][0]).update(change)
    path.write_text(json.dumps(content))
    (dataset,) = open_datasets(root)
    with pytest.raises(ValueError, match=message) as caught:
        dataset.scene("000003/000002")
    assert str(caught.value).startswith(str(path))


def test_the_writer_refuses_what_disagrees(tmp_path: Path, make_pile: Callable[..., Any]) -> None:
    pile = make_pile(2)
    writer = BopSceneWriter(tmp_path / "000000")
    with pytest.raises(ValueError, match="must be of 2 parts, got 2, 2, 3 and instance"):
        writer.write(0, pile.pinhole, *pile[1:6], [1, 1, 1])
    with pytest.raises(ValueError, match="depth image must have the camera's 120 x 96 pixels, got 96 x 120"):
        writer.write(0, pile.pinhole, pile.depth.T, *pile[2:6], [1, 1])
    with pytest.raises(ValueError, match=r"depth must lie in 0\.001\.\.65\.53 m"):
        writer.write(0, pile.pinhole, pile.depth * 100, *pile[2:6], [1, 1])
    assert not list(tmp_path.iterdir())


@settings(max_examples=20, deadline=None)
@given(
    fx=st.floats(50, 9000), fy=st.floats(50, 9000), cx=st.floats(-100, 3000), cy=st.floats(-100, 3000),
    seed=st.integers(0, 10**6),
)  # fmt: skip
def test_any_camera_and_pose_survives(
    tmp_path_factory: pytest.TempPathFactory, fx: float, fy: float, cx: float, cy: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = transform(matrix_from_quaternion(random_quaternion(rng, (3,))), rng.uniform((-1, -1, 0.1), 3, (3, 3)))
    depth, camera = rng.uniform(0.3, 6.0, (8, 12)), PinholeCamera(12, 8, fx, fy, cx, cy)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    writer = BopSceneWriter(tmp_path_factory.mktemp("any") / "test" / "000000")
    visible = rng.random(3)
    writer.write(
        5, camera, depth, rng.integers(-1, 3, depth.shape), np.zeros((3, 8, 12), bool), poses, visible, [9] * 3
    )
    writer.finish()
    dataset = BopDataset([writer._folder])
    frame = dataset.frame("000000/000005")
    assert frame.camera == camera
    np.testing.assert_allclose(frame.ground_truth.camera_from_part, poses, atol=1e-12)
    np.testing.assert_array_equal(np.isnan(frame.depth), np.isnan(depth))
    np.testing.assert_allclose(frame.depth, depth, atol=0.0501 / 1000)


def test_a_mesh_is_written_in_millimetres(tmp_path: Path, box: Part) -> None:
    import trimesh

    write_models(tmp_path, {1: box})
    mesh = trimesh.load(tmp_path / "obj_000001.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, box.vertices * 1000, atol=1e-4)
    np.testing.assert_array_equal(mesh.faces, box.faces)
