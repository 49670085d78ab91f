"""The Sileane layout: the check data's real files, and an object's folder written by hand with a moved camera."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from attentionvote.datasets import open_datasets
from attentionvote.datasets.sileane import SileaneDataset, label_of, read_camera, read_world_poses
from attentionvote.geometry.pose import apply, matrix_from_quaternion, transform

QUATERNION, LOCATION = np.array([0.5, -0.3, 0.7, 0.1]) / np.sqrt(0.84), (0.3, -0.2, 1.4)
CLIP = (0.5, 1.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, make_pile: Callable[..., Any]) -> Path:
    """``box/`` with scenes of 0, 2 and 5 boxes; the camera stands away from the world's origin, turned."""
    folder = tmp_path_factory.mktemp("sileane") / "box"
    for name in ("depth", "segmentation", "gt"):
        (folder / name).mkdir(parents=True)
    world_from_camera = transform(matrix_from_quaternion(QUATERNION), LOCATION)
    for count in (0, 2, 5):
        pile, name = make_pile(count), f"box_1_{count:03d}"
        counts = np.rint((np.nan_to_num(pile.depth, posinf=CLIP[1]) - CLIP[0]) / (CLIP[1] - CLIP[0]) * 65535)
        Image.fromarray(counts.astype(np.uint16)).save(folder / "depth" / f"{name}.PNG", format="PNG")
        ids = [round(65535 * (count - k) / count) for k in range(count)]
        labels = np.array([*ids, 0])[pile.instance]
        Image.fromarray(labels.astype(np.uint16)).save(folder / "segmentation" / f"{name}.PNG", format="PNG")
        poses = world_from_camera @ pile.camera_from_part
        entries = [
            {"R": p[:3, :3].tolist(), "t": p[:3, 3].tolist(), "segmentation_id": i, "occlusion_rate": 1 - float(v)}
            for p, i, v in zip(poses, ids, pile.visible_fraction, strict=True)
        ]
        (folder / "gt" / f"{name}.json").write_text(json.dumps(entries))
    c = pile.camera
    said = {"width": c.width, "height": c.height, "fu": c.fx, "fv": c.fy, "cu": c.cx, "cv": c.cy}
    said |= {"clip_start": CLIP[0], "clip_end": CLIP[1]}
    lines = [f"{key}\t{value} # a comment" for key, value in said.items()]
    lines += ["# a line of its own", "", "location " + " ".join(map(str, LOCATION))]
    lines += ["rotation " + " ".join(map(str, QUATERNION))]
    (folder / "camera_params.txt").write_text("\n".join(lines))
    return folder


def test_world_poses_come_into_the_camera_frame_and_labels_become_rows(
    folder: Path, make_pile: Callable[..., Any]
) -> None:
    (dataset,) = open_datasets(folder.parent)
    assert (dataset.format, dataset.title, dataset.parts) == ("sileane", "box", ("box",))
    assert dataset.names == ("box_1_000", "box_1_002", "box_1_005")
    assert [dataset.drop_count(name) for name in dataset.names] == [0, 2, 5]
    pile = make_pile(5)
    frame = dataset.frame("box_1_005")
    np.testing.assert_allclose(frame.ground_truth.camera_from_part, pile.camera_from_part, atol=1e-9)
    np.testing.assert_allclose(frame.ground_truth.occlusion_rate, 1 - pile.visible_fraction, atol=1e-12)
    np.testing.assert_array_equal(frame.instance, pile.instance)
    assert frame.ground_truth.label_ids[0] == 65535  # the first part, not the background
    scene = dataset.scene("box_1_005")
    parts = pile.instance >= 0
    # By the empty bin's picture; 5 mm above the floor nothing is told from it.
    on_parts = scene.instance_ids >= 0
    assert on_parts.all()
    assert 0.9 * parts.sum() < len(scene.points) <= parts.sum()
    exact = pile.exact_points[parts]
    nearest = np.linalg.norm(scene.points[:200, None] - exact[None], axis=-1).min(axis=1)
    assert nearest.max() < 6e-6
    assert len(dataset.scene("box_1_000").points) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": [100.0, 2.0, 850.0]}, "the translation of entry 1 must be in metres, got .*: looks like millimetres"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "R of entry 1 must be a rotation .*determinant -1"),
        ({"R": [[1, 0, 0], [0, 1, 0]]}, "nine numbers R and three numbers t"),
        ({"occlusion_rate": 30}, r"occlusion_rate must lie in 0..1, got .*30"),
        ({"segmentation_id": 65535}, "segmentation_id must be different whole numbers in 1..65535"),
        ({"t": None}, "nine numbers R and three|must be finite"),
    ],
)
def test_what_breaks_a_rule_is_one_sentence(folder: Path, tmp_path: Path, change: dict, message: str) -> None:
    entries = json.loads((folder / "gt" / "box_1_002.json").read_text())
    entries[1] |= change
    path = tmp_path / "box_1_002.json"
    path.write_text(json.dumps(entries))
    with pytest.raises(ValueError, match=message) as caught:
        read_world_poses(path)
    assert str(caught.value).startswith(str(path))
    del entries[1]["occlusion_rate"]
    path.write_text(json.dumps(entries))
    with pytest.raises(ValueError, match="entry 1 must be an object with occlusion_rate"):
        read_world_poses(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("clip_end\t1.1", "clip_end\t0.1", "0 <= clip_start < clip_end"),
        ("clip_start\t0.5", "clip_start\t500", "0 <= clip_start < clip_end"),
        ("location 0.3", "location 300 0.3", "location must have 3 numbers, got 4"),
        ("location 0.3", "location 300", "must be in metres, got .*looks like millimetres"),
        ("rotation ", "rotation 3", "rotation must be a unit quaternion"),
        ("fu\t200.0", "fu\twide", "fu must be a finite number, got 'wide'"),
        ("fv\t", "fw\t", "the key fv must be there, got only"),
    ],
)
def test_an_impossible_camera_is_one_sentence(folder: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (folder / "camera_params.txt").read_text()
    assert old in text
    path = tmp_path / "camera_params.txt"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_camera(path)


def test_every_ground_truth_file_of_the_check_data_is_read_as_evaluation_reads_it(
    shared_data: Callable[[str], Path],
) -> None:
    from attentionvote.evaluation.result_files import read_ground_truth

    (dataset,) = open_datasets(shared_data("sileane_bunny_sample"))
    assert (dataset.title, dataset.parts) == ("bunny", ("bunny",))
    assert dataset.names == tuple(f"bunny_3_{count:03d}" for count in range(70, 81))
    assert dataset.missing_files() == {"depth": list(dataset.names), "gt": []}
    np.testing.assert_allclose(dataset.diameters, [0.234355241], atol=1e-8)
    total = 0
    for name in dataset.names:
        truth = dataset.ground_truth(name)
        poses, occlusion = read_ground_truth(dataset.directory / "gt" / f"{name}.json")
        np.testing.assert_array_equal(truth.camera_from_part, poses)  # this camera is the world
        np.testing.assert_allclose(truth.occlusion_rate, occlusion, atol=1e-12)
        count = dataset.drop_count(name)
        assert len(poses) == count
        # Reference section 1b: the file's own ids follow the rule.
        np.testing.assert_array_equal(
            truth.label_ids, [np.floor(65535 * (count - k) / count + 0.5) for k in range(count)]
        )
        assert [label_of(k, count) for k in range(count)] == truth.label_ids.tolist()
        total += count
    assert total == 825


def test_the_real_frame_is_read_as_the_reference_says(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    folder = tmp_path / "bunny"
    (folder / "depth").mkdir(parents=True)
    (folder / "depth" / "bunny_3_004.PNG").symlink_to(shared_data("sileane_bunny_sample/depth.PNG"))
    (folder / "camera_params.txt").symlink_to(shared_data("sileane_bunny_sample/camera_params.txt"))
    (dataset,) = open_datasets(tmp_path)
    points = dataset.points("bunny_3_004")
    # Reference section 1b and shared/data/README.md: 925,936 valid pixels between 0.772 and 0.925 m.
    assert points.shape == (925_936, 3)
    assert 0.7715 < points[:, 2].min() < points[:, 2].max() < 0.9255
    # x = (u - cu) z / fu, no half pixel, no flip: back to whole pixels within the picture.
    camera = dataset.camera("bunny_3_004")
    some = points[:1000].astype(np.float64)
    u, v = some[:, 0] / some[:, 2] * 4507.08 + 399.557, some[:, 1] / some[:, 2] * 4507.08 + 556.6
    assert np.abs(u - u.round()).max() < 2e-3
    assert np.abs(v - v.round()).max() < 2e-3
    assert (u.min() > -0.5, v.min() > -0.5, u.max() < camera.width, v.max() < camera.height) == (True,) * 4
    with pytest.raises(ValueError, match="scene bunny_3_004 has no file of its gt"):
        dataset.scene("bunny_3_004")


def test_the_real_frame_goes_through_normals_sampling_and_the_estimator(
    shared_data: Callable[[str], Path], tmp_path: Path, make_bundle: Any, trusted_key: Path
) -> None:
    from attentionvote.geometry.pointcloud import estimate_normals, sample_indices
    from attentionvote.inference.estimator import Estimate, PoseEstimator

    folder = tmp_path / "bunny"
    (folder / "depth").mkdir(parents=True)
    (folder / "depth" / "frame.PNG").symlink_to(shared_data("sileane_bunny_sample/depth.PNG"))
    (folder / "camera_params.txt").symlink_to(shared_data("sileane_bunny_sample/camera_params.txt"))
    points = SileaneDataset(folder).points("frame")
    rng = np.random.default_rng(0)
    dense = points[sample_indices(len(points), 60_000, rng)]
    normals = estimate_normals(dense, dense[:2000])
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert (np.einsum("pi,pi->p", normals, dense[:2000]) <= 0).all()
    # A scanner looking down at clutter: most of the surface faces it, as no shuffled or flipped frame would have it.
    assert np.median(-normals[:, 2]) > 0.8
    # A part as large as a bunny, at this distance, as far as the tiny model is concerned.
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    box = ((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))
    card = {"part": {"name": "bunny", "diameter": 0.234, "box": box}, "distance": (0.75, 0.95), "extent": extent}
    with PoseEstimator(make_bundle(card=card, golden=1), trusted=trusted_key) as estimator:
        answer = estimator.estimate(points)
    assert isinstance(answer, Estimate)
    assert answer.warnings == ()
    assert answer.points_used == len(points)
    middle = np.array([d.camera_from_part[:3, 3] for d in answer.detections])
    assert np.linalg.norm(middle - points.mean(axis=0), axis=1).max() < 0.06  # the tiny graph: near the centroid


def test_apply_of_a_read_pose_lands_on_the_parts_own_points(folder: Path) -> None:
    scene = SileaneDataset(folder).scene("box_1_005")
    half = np.array([0.03, 0.02, 0.01])
    for row, pose in enumerate(scene.camera_from_part):
        own = scene.points[scene.instance_ids == row].astype(np.float64)
        local = (own - pose[:3, 3]) @ pose[:3, :3]
        np.testing.assert_allclose(apply(pose, local), own, atol=1e-12)
        assert (np.abs(local) <= half + 1e-5).all()  # on the box, in the box's own frame


def test_poses_that_are_the_cameras_already_are_noticed(folder: Path, tmp_path: Path, make_pile: Any) -> None:
    import shutil

    from attentionvote.datasets.check import check_dataset

    assert check_dataset(SileaneDataset(folder)).errors == ()
    spoilt = Path(shutil.copytree(folder, tmp_path / "box"))
    for count in (2, 5):
        path = spoilt / "gt" / f"box_1_{count:03d}.json"
        entries = json.loads(path.read_text())
        for entry, pose in zip(entries, make_pile(count).camera_from_part, strict=True):
            entry |= {"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()}
        path.write_text(json.dumps(entries))
    (error,) = check_dataset(SileaneDataset(spoilt)).errors
    assert "with poses left as they stand in the file they would" in error


def test_cycles_and_what_a_digest_is_made_of(shared_data: Callable[[str], Path]) -> None:
    bunny = SileaneDataset(shared_data("sileane_bunny_sample"))
    assert {bunny.cycle_of(name) for name in bunny.names} == {"bunny_3"}
    assert json.loads(bunny.truth_bytes("bunny_3_070"))[0]["R"]
    assert "4507.08" in bunny.picture_rule("bunny_3_070")
    with pytest.raises(ValueError, match="there is no scene 'bunny_3_001'"):
        bunny.picture_rule("bunny_3_001")
