"""Clouds are the sensor's view of the scene, the same bits whoever measures them and however often interrupted."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from real_disks import read_only, resize, small_disk

from attentionvote.data import cloud_pool
from attentionvote.data import clouds as clouds_module
from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.sensing import CloudSettings, measure
from attentionvote.files import DiskFull, FolderUnavailable, waiting_lock
from attentionvote.geometry.pose import apply
from attentionvote.part import Part
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.simulation.sensor import Sensor


def bits(clouds: Clouds) -> list[bytes]:
    return [(clouds.directory / f"{name}.npy").read_bytes() for name in ("points", "normals", "instance_ids", "count")]


def box_distance(points: NDArray, half: NDArray) -> NDArray:
    """Distance of points in the part frame to the surface of a box with these half sides (textbook formula)."""
    outside = np.abs(points) - half
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))


def test_points_lie_on_the_posed_parts_within_the_noise(clouds: Clouds) -> None:
    for index in range(len(clouds)):
        scene = clouds[index]
        assert 100 < len(scene.points) <= 600
        distances = []
        for instance, pose in enumerate(scene.camera_from_part):
            own = scene.points[scene.instance_ids == instance]
            distances.append(box_distance(apply(np.linalg.inv(pose), own), np.array([0.03, 0.02, 0.01])))
        everything = np.concatenate(distances)
        assert len(everything) == len(scene.points)  # no background
        assert np.sqrt(np.mean(everything**2)) < 0.35e-3  # sigma 0.3 mm a coordinate
        assert everything.max() < 2e-3


def test_normals_are_unit_and_face_the_camera(clouds: Clouds) -> None:
    for index in range(len(clouds)):
        scene = clouds[index]
        assert scene.normals is not None
        np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1, atol=1e-5)
        facing = -(scene.points * scene.normals).sum(1) / np.linalg.norm(scene.points, axis=1)
        assert facing.min() > -0.02  # stored as bytes


def test_normals_agree_with_the_faces(clouds: Clouds) -> None:
    scene = clouds[0]
    assert scene.normals is not None
    in_part = scene.normals @ scene.camera_from_part[0, :3, :3]
    assert np.mean(np.abs(in_part).max(axis=1) > 0.95) > 0.6  # all but the points near edges


def test_the_pool_is_a_part_of_what_was_measured(
    clouds: Clouds, scenes: SceneSet, box: Part, settings: CloudSettings
) -> None:
    fresh = measure(scenes.records[2], PartCaster(box), settings)
    np.testing.assert_array_equal(clouds[2].points, fresh.points)
    np.testing.assert_array_equal(clouds[2].instance_ids, fresh.instance_ids)
    np.testing.assert_allclose(clouds[2].normals, fresh.normals, atol=0.02)


def test_processes_change_nothing(
    clouds: Clouds, scenes: SceneSet, box: Part, settings: CloudSettings, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("attentionvote.data.clouds._SCENES_PER_PROCESS", 1)
    again = measure_clouds(scenes, box, settings, folder, 2, progress=False)
    assert bits(again) == bits(clouds)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interruption_changes_nothing(
    clouds: Clouds,
    scenes: SceneSet,
    box: Part,
    settings: CloudSettings,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: type[BaseException],
) -> None:
    calls = []

    def interrupted(record: SceneRecord, caster: PartCaster, chosen: CloudSettings) -> Scene:
        calls.append(record)
        if len(calls) == 3:
            raise error
        return measure(record, caster, chosen)

    monkeypatch.setattr(cloud_pool, "measure", interrupted)
    with pytest.raises(error):
        measure_clouds(scenes, box, settings, folder, 1, progress=False)
    again = measure_clouds(scenes, box, settings, folder, 1, progress=False)
    assert len(calls) == len(scenes) + 1  # what was finished is not measured twice
    assert bits(again) == bits(clouds)
    measure_clouds(scenes, box, settings, folder, 1, progress=False)
    assert len(calls) == len(scenes) + 1


def test_settings_have_their_own_clouds(settings: CloudSettings) -> None:
    others = [
        CloudSettings(Sensor("none"), settings.density, settings.pool, settings.neighbors),
        CloudSettings(settings.sensor, 1600, settings.pool, settings.neighbors),
        CloudSettings(settings.sensor, settings.density, 599, settings.neighbors),
        CloudSettings(settings.sensor, settings.density, settings.pool, 13),
    ]
    assert len({s.key("a") for s in [settings, *others]} | {settings.key("b")}) == 6


def test_a_pool_larger_than_the_cloud_is_refused(settings: CloudSettings) -> None:
    with pytest.raises(ValueError, match=r"pool must lie in 1..10 \(density\), got 11"):
        CloudSettings(settings.sensor, 10, 11)


def test_a_scene_nobody_sees_has_an_empty_cloud(
    make_scenes: Callable[..., SceneSet], box: Part, settings: CloudSettings, folder: Path
) -> None:
    clouds = measure_clouds(make_scenes((1,), away=True), box, settings, folder, 1, progress=False)
    assert clouds.count(0) == 0
    assert clouds[0].points.shape == (0, 3)


def test_damaged_clouds_are_named(scenes: SceneSet, box: Part, settings: CloudSettings, folder: Path) -> None:
    clouds = measure_clouds(scenes, box, settings, folder, 1, progress=False)
    stored = np.load(clouds.directory / "points.npy", mmap_mode="r+")
    stored[1, 0] = np.nan
    with pytest.raises(ValueError, match=r"cloud 1 is damaged \(scene points must be finite, got 1 .*\): delete"):
        Clouds(clouds.directory, scenes)[1]
    with (clouds.directory / "normals.npy").open("r+b") as file:
        file.truncate(200)
    with pytest.raises(ValueError, match=r"normals.npy must hold the normals .* missing or damaged: delete the folder"):
        measure_clouds(scenes, box, settings, folder, 1, progress=False)
    (clouds.directory / "points.npy").unlink()
    with pytest.raises(ValueError, match=r"points.npy must hold .*missing or damaged"):
        Clouds(clouds.directory, scenes)


def test_complete_clouds_are_used_where_nothing_can_be_written(
    clouds: Clouds, scenes: SceneSet, box: Part, settings: CloudSettings, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = measure_clouds(scenes, box, settings, folder, 1, progress=False)
    (measured.directory / ".lock").unlink()
    with read_only(folder):
        assert bits(measure_clouds(scenes, box, settings, folder, 1, progress=False)) == bits(clouds)
        other = CloudSettings(settings.sensor, settings.density, 599, settings.neighbors)
        with pytest.raises(FolderUnavailable, match="cannot be written: Read-only file system"):
            measure_clouds(scenes, box, other, folder, 1, progress=False)
    monkeypatch.setattr(clouds_module, "waiting_lock", lambda *_: pytest.fail("a lock was written"))
    measure_clouds(scenes, box, settings, folder, 1, progress=False)


def test_clouds_that_another_process_is_at_are_waited_for(
    scenes: SceneSet, box: Part, settings: CloudSettings, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = measure_clouds(scenes, box, settings, folder, 1, progress=False)
    waited = []
    with waiting_lock(measured.directory / ".lock"):
        monkeypatch.setattr(clouds_module, "waiting_lock", lambda path: waited.append(path) or nullcontext())
        measure_clouds(scenes, box, settings, folder, 1, progress=False)
    assert waited == [measured.directory / ".lock"]


def test_a_full_disk_is_named_and_the_clouds_go_on(
    clouds: Clouds, scenes: SceneSet, box: Part, settings: CloudSettings, folder: Path
) -> None:
    with small_disk(folder / "disk", "40k") as disk:
        with pytest.raises(DiskFull, match=rf"^the disk of {disk}/.* must have room"):
            measure_clouds(scenes, box, settings, disk, 1, progress=False)
        resize(disk, "1m")
        assert bits(measure_clouds(scenes, box, settings, disk, 1, progress=False)) == bits(clouds)
