"""Scenes that models are measured on, and what a measurement needs of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.sensing import CloudSettings, sense
from attentionvote.part import Parts
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_set import SceneSet

if TYPE_CHECKING:
    from attentionvote.measurement.dataset_scenes import DatasetScenes


@dataclass(frozen=True)
class EvaluationSet:
    """Generated scenes, the part in them, the sensor that sees them, and the name of their split."""

    scenes: SceneSet
    part: Parts
    settings: CloudSettings
    split: str = "evaluation"

    @property
    def digest(self) -> str:
        """Sha256 of everything that makes the clouds: same digest, same clouds."""
        return self.settings.key(self.scenes.digest)

    @property
    def title(self) -> str:
        """The sensor's preset."""
        return self.settings.sensor.preset

    @property
    def cycle_of_scene(self) -> NDArray[np.int64]:
        """``(S,)`` which drop cycle each scene is of."""
        return self.scenes.cycle_of_scene

    def __len__(self) -> int:
        return len(self.scenes)

    def clouds(self) -> Iterator[Scene]:
        """Every scene as the sensor delivers it."""
        caster = PartCaster(self.part)
        for record in self.scenes.records:
            yield sense(record, caster, self.settings)[0]


# Scenes to measure on: ours, generated, or those of somebody else's dataset.
MeasuredScenes: TypeAlias = "EvaluationSet | DatasetScenes"
