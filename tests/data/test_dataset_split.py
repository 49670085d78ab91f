"""Scenes of a dataset are the scenes that were written: same points, same owners, same poses, same visibility."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from written_piles import pile_records, write_piles

from attentionvote.data.clouds import measure_clouds
from attentionvote.data.dataset_split import DatasetSensing, DatasetSplit, check_sensor
from attentionvote.data.nearest_surface import PartSurface
from attentionvote.data.samples import draw_sample
from attentionvote.data.sensing import CloudSettings, sense
from attentionvote.datasets import Dataset, open_datasets
from attentionvote.model.neighborhoods import Layout
from attentionvote.part import Part
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.sensor import Sensor

EXACT = CloudSettings(Sensor("none"), density=40_000, pool=40_000, neighbors=12)


@pytest.fixture(scope="module")
def records(box: Part) -> list[SceneRecord]:
    return pile_records(box, 2, (2, 5))


@pytest.fixture(scope="module")
def written(box: Part, records: list[SceneRecord], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_piles(folder / "ipa" / "training" / "box", box, records)
    write_piles(folder / "bop" / "box" / "train", box, records, "bop")
    return folder


def only(folder: Path) -> Dataset:
    (dataset,) = open_datasets(folder)
    return dataset


def split_of(folder: Path, part: Part) -> DatasetSplit:
    dataset = only(folder)
    return DatasetSplit(dataset, dataset.scored_names, part)


@pytest.mark.parametrize("kind", ["ipa", "bop"])
def test_a_written_scene_gives_the_samples_of_the_generated_one(
    written: Path, box: Part, records: list[SceneRecord], kind: str, folder: Path, layout: Layout
) -> None:
    split = split_of(written / kind, box)
    five = [record for record in records if record.drop_count == 5]
    assert len(split) == len(five)  # piles of two are not scored
    clouds = measure_clouds(split, box, EXACT, folder, 1, progress=False)
    for index, record in enumerate(five):
        made, read = sense(record, PartCaster(box), EXACT)[0], clouds[index]
        # Both hold every pixel that shows a part; depth is written in steps of 10 micrometres at most.
        assert len(made.points) == len(read.points) > 1000
        distance, nearest = cKDTree(made.points).query(read.points)
        assert distance.max() < 1.5e-5
        assert (made.instance_ids[nearest] == read.instance_ids).mean() > 0.999
        np.testing.assert_allclose(read.camera_from_part, made.camera_from_part, atol=1e-9)
        np.testing.assert_allclose(read.visible_fraction, made.visible_fraction, atol=1e-9)
        sample = draw_sample(read, 256, layout, None, np.random.default_rng(0))
        np.testing.assert_allclose(sample.center, made.camera_from_part[:, :3, 3], atol=1e-6)
        np.testing.assert_allclose(sample.rotation, made.camera_from_part[:, :3, :3], atol=1e-6)
        assert sample.normals.norm(dim=1).numpy() == pytest.approx(1, abs=1e-4)


def test_noise_thinning_and_processes(written: Path, box: Part) -> None:
    dataset = only(written / "ipa")
    name = dataset.scored_names[0]
    exact, _ = DatasetSensing(dataset, box, Sensor("none"), 800)(name)
    sensing = DatasetSensing(dataset, box, Sensor("gaussian", sigma_mm=1.0), 800)
    noisy, rng = sensing(name)
    assert len(exact.points) == len(noisy.points) == 800
    assert np.std(noisy.points - exact.points) == pytest.approx(1e-3, rel=0.1)
    again, same = pickle.loads(pickle.dumps(sensing))(name)  # in another process
    np.testing.assert_array_equal(again.points, noisy.points)
    assert rng.integers(1000) == same.integers(1000)
    with pytest.raises(ValueError, match=r"data.sensor.preset must be gaussian or none with data.dataset.*got 'phoxi'"):
        check_sensor(Sensor("phoxi"))


def test_without_labels_the_surface_says_whose_a_point_is(written: Path, box: Part, tmp_path: Path) -> None:
    shutil.copytree(written / "ipa" / "training", tmp_path / "ipa")
    shutil.rmtree(tmp_path / "ipa" / "box" / "p_segmentation")
    told, derived = (only(folder) for folder in (written / "ipa", tmp_path / "ipa"))
    assert not derived.has_labels
    for name in told.scored_names:
        scenes = [DatasetSensing(d, box, Sensor("none"), 40_000)(name)[0] for d in (told, derived)]
        np.testing.assert_array_equal(scenes[0].points, scenes[1].points)
        # Random poses overlap: where two surfaces meet, either may be the nearer one.
        assert (scenes[0].instance_ids == scenes[1].instance_ids).mean() > 0.97
    # Whose points they are depends on the part then, and with it the clouds.
    thicker = replace(box, vertices=box.vertices * 1.01)
    digests = [DatasetSplit(d, d.scored_names, p).digest for d in (told, derived) for p in (box, thicker)]
    assert digests[0] == digests[1] != digests[2] != digests[3]


def test_points_off_every_surface_are_nobodys(box: Part) -> None:
    surface = PartSurface(box)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.0, 0.5
    top = np.array([0.1, 0.0, 0.51])  # the box is 20 mm thick
    points = top + np.array([[0, 0, 0], [0, 0, 0.002], [0, 0, 0.004], [1, 0, 0]])
    np.testing.assert_array_equal(surface.owners(points, pose[None]), [0, 0, -1, -1])  # 3 % of 75 mm
    np.testing.assert_array_equal(surface.owners(points, np.zeros((0, 4, 4))), [-1] * 4)
    assert surface.distances(points[:2], pose) == pytest.approx([0, 0.002], abs=5e-4)


def test_neither_labels_nor_background_is_refused(written: Path, box: Part, tmp_path: Path) -> None:
    shutil.copytree(written / "bop", tmp_path / "bop")
    for masks in (tmp_path / "bop").rglob("mask_visib"):
        shutil.rmtree(masks)
    dataset = only(tmp_path / "bop")
    with pytest.raises(
        ValueError, match=r"scene 000000/000001 must have labels or a picture of the empty bin to train"
    ):
        DatasetSensing(dataset, box, Sensor("none"), 100)(dataset.scored_names[0])


@pytest.mark.parametrize("kind", ["ipa", "bop"])
def test_the_digest_is_of_poses_visibility_and_camera(written: Path, box: Part, tmp_path: Path, kind: str) -> None:
    before = split_of(written / kind, box)
    shutil.copytree(written / kind, tmp_path / kind)
    same = split_of(tmp_path / kind, box)
    assert (same.digest, same.fingerprint) == (before.digest, before.fingerprint)
    assert len(before.fingerprint) == 16  # of two cycles
    cycle_names = [list(before.cycles)[i] for i in before.cycle_of_scene]
    assert cycle_names == [before.dataset.cycle_of(name) for name in before.names]
    camera = next((tmp_path / kind).rglob("parameter.json" if kind == "ipa" else "scene_camera.json"))
    camera.write_text(camera.read_text().replace('"clip_end": ', '"clip_end": 1').replace("300.0", "301.0"))
    other = split_of(tmp_path / kind, box)
    assert other.digest != before.digest
    assert other.fingerprint == before.fingerprint  # the same scenes, though
    truth = sorted((tmp_path / kind).rglob("005.csv" if kind == "ipa" else "scene_gt.json"))[-1]
    truth.write_text(truth.read_text().replace("0.1", "0.2"))
    changed = split_of(tmp_path / kind, box)
    assert changed.fingerprint[:8] == before.fingerprint[:8]
    assert changed.fingerprint[8:] != before.fingerprint[8:]
