"""Clouds of the boxes of ``tests/fixtures/box_scenes.py``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.sensing import CloudSettings
from attentionvote.model.neighborhoods import Layout
from attentionvote.part import Part
from attentionvote.simulation.scene_set import SceneSet
from attentionvote.simulation.sensor import Sensor

SETTINGS = CloudSettings(Sensor("gaussian", sigma_mm=0.3), density=1500, pool=600, neighbors=12)


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
