"""Scenes a training never saw: found by their digest, spread over the cycles, measured as the training did."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from attentionvote.data.sensing import CloudSettings, sense
from attentionvote.export import held_out
from attentionvote.export.checkpoint_card import model_card
from attentionvote.model.network import AttentionVote
from attentionvote.part import Part
from attentionvote.section import read
from attentionvote.simulation import cycle
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_set import SceneSet, generate_scene_set
from attentionvote.simulation.scene_spec import SimulationSettings, scene_set_directory, scene_set_specs
from attentionvote.simulation.sensor import Sensor

CAMERA = {"width": 344, "height": 257, "fx": 567.0, "fy": 567.0, "cx": 172.0, "cy": 128.5}
SETTINGS: dict[str, Any] = {
    "seed": 3,
    "cycles": {"train": 1, "test": 2},
    "drop_counts": [1, 2],
    "bin": {"size": None, "jitter": 0.1},
    "camera": {
        "camera": CAMERA, "distance": None, "distance_jitter": 0.05, "shift": 0.01, "tilt_degrees": 3.0,
        "roll_degrees": 10.0,
    },
    "drop": {
        "timestep": 0.008, "contact_time": 0.02, "friction": [0.2, 0.6], "hull_threshold": 0.1, "hull_vertices": 64,
        "speed": 0.5, "timeout": 1.5,
    },
    "visibility_stride": 4,
}  # fmt: skip


@pytest.fixture(scope="module")
def root(part: Part, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with the train and test scenes of a brick."""
    folder = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cycle, "convex_hulls", lambda p, *_, **__: (p.vertices[ConvexHull(p.vertices).vertices],))
        for spec in scene_set_specs(part, read(SimulationSettings, SETTINGS)).values():
            directory = scene_set_directory(folder / "scenes", part.name, spec)
            generate_scene_set(part, spec, directory, progress=False)
    return folder


@pytest.fixture
def metadata(root: Path, part: Part, make_metadata: Callable[..., dict[str, Any]]) -> dict[str, Any]:
    digest = SceneSet.open(next((root / "scenes" / part.name).glob("test-*"))).digest
    return make_metadata(data={"test": digest})


def test_the_scenes_are_found_by_their_content(root: Path, part: Part, metadata: dict[str, Any]) -> None:
    scenes = held_out.find_test_scenes(metadata, part, root)
    assert scenes.directory.name.startswith("test-")
    assert len(scenes) == 4


def test_other_scenes_and_other_parts_are_not_taken(root: Path, part: Part, metadata: dict[str, Any]) -> None:
    gone = metadata | {"data": {"test": "f" * 64}}
    with pytest.raises(ValueError, match=r"the test scenes ffffffffffff of the training must lie below .*, or make"):
        held_out.find_test_scenes(gone, part, root)
    with pytest.raises(ValueError, match=r"brick must be the part the network was trained for .* has changed"):
        held_out.find_test_scenes(metadata, replace(part, diameter=0.05), root)


def test_an_unfinished_set_is_passed_over(root: Path, part: Part, metadata: dict[str, Any], tmp_path: Path) -> None:
    folder = tmp_path / "scenes" / part.name / "test-unfinished"
    folder.mkdir(parents=True)
    found = held_out.find_test_scenes(metadata, part, root)
    manifest = json.loads((found.directory / "manifest.json").read_text(encoding="utf-8"))
    (folder / "manifest.json").write_text(json.dumps(manifest | {"content_digest": None}), encoding="utf-8")
    with pytest.raises(ValueError, match="must lie below"):
        held_out.find_test_scenes(metadata, part, tmp_path)


@pytest.mark.parametrize(
    ("total", "count", "expected"),
    [(10, 3, [0, 4, 9]), (3, 5, [0, 1, 2]), (1, 4, [0]), (100, 2, [0, 99])],
)
def test_a_choice_is_spread_over_all(total: int, count: int, expected: list[int]) -> None:
    assert held_out.spread(total, count) == expected


def test_samples_and_sensor_clouds_are_of_the_same_measurement(
    root: Path, part: Part, metadata: dict[str, Any], network: AttentionVote
) -> None:
    scenes = held_out.find_test_scenes(metadata, part, root)
    settings = CloudSettings.of(metadata["clouds"])
    clouds = held_out.measured(scenes, part, settings, root, workers=1)
    drawn = list(held_out.samples(clouds, [1, 3], 300, network.layout))
    again = list(held_out.samples(clouds, [3], 300, network.layout))
    assert [d.points.shape for d in drawn] == [(1, 300, 3)] * 2
    np.testing.assert_array_equal(drawn[1].points, again[0].points)
    whole = sense(scenes.records[3], PartCaster(part), settings)[0].points
    assert 500 < len(whole) <= settings.density
    sampled = {tuple(p) for p in drawn[1].points[0].numpy().tolist()}
    assert sampled <= {tuple(p) for p in whole.tolist()}
    (near, far), extent = held_out.working_volume(clouds, scenes)
    low, high = whole.min(0), whole.max(0)
    assert near <= low[2] + 0.002 < high[2] - 0.002 <= far
    assert extent >= (high - low).max() - 0.002
    card = model_card(network, metadata, part, (near, far), extent, "run", "commit")
    assert (card.points, card.votes, card.proposals, card.density) == (300, 32, 8, 2000)
    assert type(card).from_json(card.to_json()) == card


def test_of_a_cell_the_whole_bin_counts(part: Part, tmp_path: Path) -> None:
    """A heap in a corner of a wide bin: the cell will send all of the bin, which is no other scene than was trained."""
    wide = {
        "bin": {"size": [10 * part.diameter, 8 * part.diameter, 2 * part.diameter], "jitter": 0.0, "walls": {}},
        "camera": SETTINGS["camera"] | {"distance": 12 * part.diameter},
        "drop": SETTINGS["drop"] | {"area": [1.5 * part.diameter, 1.5 * part.diameter]},
    }
    spec = scene_set_specs(part, read(SimulationSettings, SETTINGS | wide))["test"]
    scenes = generate_scene_set(part, spec, scene_set_directory(tmp_path, part.name, spec), progress=False)
    clouds = held_out.measured(scenes, part, CloudSettings(Sensor(), 2000, 1000), tmp_path, workers=1)
    (near, far), extent = held_out.working_volume(clouds, scenes)
    assert extent == pytest.approx(10 * part.diameter)
    # From the rim, two thirds of its height above the point looked at, to the floor, whatever the distance was.
    assert near == pytest.approx((12 * 0.95 - 2 / 3 * 2) * part.diameter)
    assert far == pytest.approx((12 * 1.05 + 1 / 3 * 2) * part.diameter)
    heap = max(np.ptp(clouds[index].points, axis=0).max() for index in range(len(clouds)))
    assert heap < extent / 2


def test_a_card_needs_a_finished_training(network: AttentionVote, metadata: dict[str, Any], part: Part) -> None:
    with pytest.raises(ValueError, match="must be of a finished training"):
        model_card(network, metadata | {"confidence_threshold": None}, part, (0.5, 0.6), 0.2)
