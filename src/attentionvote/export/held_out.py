"""The scenes that a training never saw, found again by the digest it kept: for the proof, for golden clouds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.dataset_split import DatasetSensing, DatasetSplit
from attentionvote.data.dataset_splits import DatasetSplits
from attentionvote.data.samples import Batch, collate, draw_sample
from attentionvote.data.sensing import CloudSettings, sense
from attentionvote.datasets import UnknownLayout
from attentionvote.model.neighborhoods import Layout
from attentionvote.part import Parts
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_set import SceneSet


def find_test_scenes(metadata: dict[str, Any], part: Parts, root: Path) -> SceneSet | DatasetSplit:
    """The test scenes of a training, below ``root/scenes/PART``, or where the dataset was that it took.

    Args:
        metadata: of the checkpoint; ``data.test`` is the content's digest.
        part: must be the one the network was trained for.
        root: where data lie.

    Raises:
        ValueError: when the part has changed since, or the scenes are gone.
    """
    trained = metadata["part"]
    if trained["digest"] != part.digest:
        raise ValueError(
            f"{part.name} must be the part the network was trained for ({trained['digest'][:12]}), got "
            f"{part.digest[:12]}: its mesh, diameter or symmetry has changed, train it again"
        )
    wanted = metadata["data"].get("test", "")
    if metadata.get("dataset"):
        return _read_again(metadata["dataset"], part, wanted)
    for manifest in sorted((root / "scenes" / part.name).glob("test-*/manifest.json")):
        if SceneSet.is_complete(manifest.parent):
            scenes = SceneSet.open(manifest.parent)
            if scenes.digest == wanted:
                return scenes
    raise ValueError(
        f"the test scenes {wanted[:12]} of the training must lie below {root / 'scenes' / part.name}, but they do not: "
        "name their place with root=..., or make them again with `make generate` and the training's simulation settings"
    )


def _read_again(record: dict[str, Any], part: Parts, wanted: str) -> DatasetSplit:
    folder = Path(record["folder"])
    try:
        test_scenes = DatasetSplits.open(folder, part.parts[0], record["held_out"]).splits["test"]
    except UnknownLayout as error:
        raise ValueError(f"the dataset that the network was trained on must be where it was: {error}") from error
    if test_scenes.digest != wanted:
        raise ValueError(
            f"{folder} must hold the test scenes {wanted[:12]} that the network was trained with, got "
            f"{test_scenes.digest[:12]}: the dataset has changed, train it again"
        )
    return test_scenes


def measured(scenes: SceneSet | DatasetSplit, part: Parts, settings: CloudSettings, root: Path, workers: int) -> Clouds:
    """The clouds of the scenes as the training saw them; measured again where they are gone."""
    return measure_clouds(scenes, part, settings, root / "clouds", workers)


def whole_clouds(
    scenes: SceneSet | DatasetSplit, part: Parts, settings: CloudSettings, indices: Iterable[int]
) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Name and points ``(P, 3)`` of these scenes as the sensor delivers them, up to ``density`` points."""
    if isinstance(scenes, SceneSet):
        caster = PartCaster(part)
        for record in (scenes.records[index] for index in indices):
            yield f"scene_{record.cycle:03d}_{record.drop_count:03d}", sense(record, caster, settings)[0].points
        return
    sensing = DatasetSensing(scenes.dataset, scenes.part, settings.sensor, settings.density)
    for name in (scenes.names[index] for index in indices):
        yield "scene_" + name.replace("/", "_"), sensing(name)[0].points


def spread(total: int, count: int) -> list[int]:
    """``count`` of ``total`` indices, evenly spread; all of them when there are fewer.

    Scenes of a drop cycle follow each other with more and more parts: a spread choice meets every filling.
    """
    return [int(i) for i in np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))]


def samples(clouds: Clouds, indices: list[int], points: int, layout: Layout) -> Iterator[Batch]:
    """Batches of one: the network's input for each scene, drawn reproducibly; empty scenes are left out."""
    for index in indices:
        if clouds.count(index) >= 3:
            rng = np.random.default_rng([0, index])
            yield collate([draw_sample(clouds[index], points, layout, None, rng)])


def working_volume(clouds: Clouds, scenes: SceneSet | DatasetSplit) -> tuple[tuple[float, float], float]:
    """Nearest and farthest depth, and the largest side of the box around a cloud, over all scenes, metres.

    Of a cell, whose bin is one of the world's (it has walls), the whole bin counts, wherever in it the piles lay, from
    the rim at the least distance that training draws to the floor at the largest: what is sent there is the bin's
    inside, full or nearly empty.
    """
    near, far, extent = np.inf, 0.0, 0.0
    for index in range(len(clouds)):
        points = clouds[index].points
        if len(points) >= 3:
            low, high = points.min(0), points.max(0)
            near, far = min(near, float(low[2])), max(far, float(high[2]))
            extent = max(extent, float((high - low).max()))
    if not extent > 0:
        raise ValueError("the test scenes must hold parts that can be seen, got only empty ones")
    if isinstance(scenes, SceneSet) and (cell := scenes.cell_volume) is not None:
        near, far, extent = min(near, cell[0]), max(far, cell[1]), max(extent, cell[2])
    return (near, far), extent
