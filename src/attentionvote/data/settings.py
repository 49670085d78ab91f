"""Settings of a training's data: the group ``conf/data``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from attentionvote.data.augmentation import Augmentation
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.sensor import Sensor

LOADERS = Setting(
    "Loader processes of each process; 0 = in the training process.", low=0, high=1024, identity=Identity.NEVER
)


@dataclass(frozen=True)
class HeldOut:
    """Share of a dataset's drop cycles for validation and test, where it has no such split of its own."""

    val: Annotated[float, Setting("For validation.", above=0, high=0.4)]
    test: Annotated[float, Setting("For the test.", above=0, high=0.4)]


@dataclass(frozen=True)
class DataSettings:
    """What the sensor measures, and what one sample of it is."""

    dataset: Annotated[
        str | None, Setting("Folder of a dataset to train on (docs/datasets.md); null = scenes by physics.")
    ]
    held_out: HeldOut
    sensor: Sensor
    density: Annotated[
        int, Setting("Most points on which normals are estimated; the cell uses the same.", low=3, high=10_000_000)
    ]
    pool: Annotated[
        int, Setting("Points kept of them per scene; each epoch draws its sample from these.", low=3, high=10_000_000)
    ]
    normal_neighbors: Annotated[int, Setting("Neighbours of the normal estimation.", low=3, high=1000)]
    points: Annotated[int, Setting("N, points of a sample.", low=3, high=10_000_000)]
    augmentation: Augmentation
    workers: Annotated[int, LOADERS]
