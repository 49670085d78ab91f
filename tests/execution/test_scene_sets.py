"""Scene sets and clouds on every executor: the same bits as in one process, whatever dies on the way."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from scipy.spatial import ConvexHull

from attentionvote.data.clouds import measure_clouds
from attentionvote.data.sensing import CloudSettings
from attentionvote.execution import Executor, RayCluster
from attentionvote.part import Part
from attentionvote.simulation import cycle, scene_set
from attentionvote.simulation.camera import Camera, CameraSettings
from attentionvote.simulation.drop_settings import DropSettings
from attentionvote.simulation.scene_set import SceneSet, generate_scene_set
from attentionvote.simulation.scene_spec import SceneSetSpec
from attentionvote.simulation.sensor import Sensor

pytestmark = pytest.mark.slow


def spec_of(box: Part, cycles: int = 12) -> SceneSetSpec:
    camera = CameraSettings(Camera(160, 120, 250, 250, 80, 60))
    drop = DropSettings(timestep=0.008, contact_time=0.02)
    return SceneSetSpec(box.digest, "train", cycles, drop_counts=(1, 2), drop=drop, camera=camera, visibility_stride=4)


def shards(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((directory / "cycles").glob("*.npz"))}


@pytest.fixture(autouse=True)
def quick_hulls(box: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cycle, "convex_hulls", lambda *_, **__: (box.vertices[ConvexHull(box.vertices).vertices],))


@pytest.fixture(scope="session")
def one_process(box: Part, tmp_path_factory: pytest.TempPathFactory) -> SceneSet:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cycle, "convex_hulls", lambda *_, **__: (box.vertices[ConvexHull(box.vertices).vertices],))
        return generate_scene_set(box, spec_of(box), tmp_path_factory.mktemp("one"), progress=False)


def test_a_scene_set_has_the_same_bits_wherever_its_workers_are(
    executor: Executor, one_process: SceneSet, box: Part, tmp_path: Path
) -> None:
    scenes = generate_scene_set(box, spec_of(box), tmp_path / "set", 2, progress=False, executor=executor)
    assert scenes.digest == one_process.digest
    assert shards(scenes.directory) == shards(one_process.directory)
    assert len(shards(scenes.directory)) == 12


def test_clouds_have_the_same_bits_wherever_they_are_measured(
    executor: Executor, one_process: SceneSet, box: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("attentionvote.data.clouds._SCENES_PER_PROCESS", 1)
    settings = CloudSettings(Sensor("gaussian", sigma_mm=0.3), density=1500, pool=600, neighbors=12)
    here = measure_clouds(one_process, box, settings, tmp_path / "here", 1, progress=False)
    there = measure_clouds(one_process, box, settings, tmp_path / "there", 2, progress=False, executor=executor)
    for name in ("points", "normals", "instance_ids", "count", "done"):
        assert (there.directory / f"{name}.npy").read_bytes() == (here.directory / f"{name}.npy").read_bytes()


def test_the_cycle_of_a_killed_ray_worker_is_done_again(
    ray_cluster: RayCluster, one_process: SceneSet, box: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, stored, killed = tmp_path / "set", [], []
    save: Callable[..., None] = scene_set.save_records

    def recording(path: Path, records: list) -> None:
        stored.append(int(path.stem))
        save(path, records)

    monkeypatch.setattr(scene_set, "save_records", recording)

    def kill_one() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not killed:
            ours = psutil.Process().children(recursive=True)
            busy = [p for p in ours if stored and p.name().startswith("ray::_perform")]
            if busy:
                os.kill(busy[0].pid, signal.SIGKILL)
                killed.append(len(stored))
            time.sleep(0.002)

    killer = threading.Thread(target=kill_one)
    killer.start()
    scenes = generate_scene_set(box, spec_of(box, 60), directory, 2, progress=False, executor=ray_cluster)
    killer.join()
    assert 0 < killed[0] < 60
    assert sorted(stored) == list(range(60))  # nothing twice, nothing lost
    monkeypatch.undo()
    kept = {name: data for name, data in shards(directory).items() if int(name[:5]) < 12}
    assert kept == shards(one_process.directory)  # a cycle does not depend on how many there are
    assert SceneSet.is_complete(scenes.directory)
