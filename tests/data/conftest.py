"""A scene set of boxes before a camera, without physics, and its clouds."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from attentionvote.data.clouds import Clouds, CloudSettings, measure_clouds
from attentionvote.geometry.pose import matrix_from_quaternion, random_quaternion, transform
from attentionvote.model import Layout
from attentionvote.part import Part
from attentionvote.simulation import Camera, PartCaster, SceneRecord, SceneSet, Sensor
from attentionvote.simulation.scene_record import save_records

SETTINGS = CloudSettings(Sensor("gaussian", sigma_mm=0.3), density=1500, pool=600, neighbors=12)


@pytest.fixture(scope="session")
def box() -> Part:
    mesh = trimesh.creation.box((0.06, 0.04, 0.02))
    return Part("box", np.array(mesh.vertices), np.array(mesh.faces), 0.075)


@pytest.fixture(scope="session")
def make_scenes(box: Part, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., SceneSet]:
    """A scene set; scene i has ``counts[i]`` boxes."""

    def make(counts: tuple[int, ...], away: bool = False) -> SceneSet:
        caster, camera = PartCaster(box), Camera(160, 120, 300.0, 300.0, 80.0, 60.0)
        rng, records = np.random.default_rng(5), []
        for index, count in enumerate(counts):
            place = np.array([5.0 if away else 0.0, 0, 0.5]) + rng.uniform(-0.06, 0.06, (count, 3)) * [1, 1, 0.3]
            poses = transform(matrix_from_quaternion(random_quaternion(rng, (count,))), place)
            visible = np.zeros(count) if away else caster.visible_fraction(poses, camera, None)
            bin_pose = transform(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.7))
            records.append(
                SceneRecord(0, count, poses, visible, camera, bin_pose, np.array([0.6, 0.6, 0.1]), 0.4, 100 + index)
            )
        directory = tmp_path_factory.mktemp("scenes")
        (directory / "cycles").mkdir()
        save_records(directory / "cycles" / "00000.npz", records)
        manifest = {"spec": {"cycles": 1}, "spec_digest": "s", "content_digest": f"boxes-{counts}-{away}"}
        (directory / "manifest.json").write_text(json.dumps(manifest))
        return SceneSet.open(directory)

    return make


@pytest.fixture(scope="session")
def scenes(make_scenes: Callable[..., SceneSet]) -> SceneSet:
    return make_scenes((1, 2, 3, 4, 5))


@pytest.fixture(scope="session")
def settings() -> CloudSettings:
    return SETTINGS


@pytest.fixture(scope="session")
def clouds(scenes: SceneSet, box: Part, tmp_path_factory: pytest.TempPathFactory) -> Clouds:
    return measure_clouds(scenes, box, SETTINGS, tmp_path_factory.mktemp("clouds"), 1, progress=False)


@pytest.fixture(scope="session")
def layout() -> Layout:
    return Layout((32, 16, 8, 4), (6, 6, 4, 4), (0.01, 0.02, 0.03, 0.06))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "clouds"
