"""Scenes of somebody else's dataset as something to train on: their digest, their poses, and their clouds.

A scene's cloud is its picture without the background, up to ``density`` points of it in a random order that the
scene's name decides, with the noise of a ``gaussian`` sensor (Table 4 of the paper); ``none`` leaves what was measured.
Where the format does not tell the bin from the parts, the labels do. Without labels, a point belongs to the posed
surface that it lies on.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import numpy as np

from attentionvote.data.nearest_surface import PartSurface
from attentionvote.datasets import Dataset, GroundTruth
from attentionvote.part import Part
from attentionvote.scene import BACKGROUND, Scene
from attentionvote.simulation.sensor import Sensor

SHORT = 8  # digits of a cycle's digest that a model card keeps


def check_sensor(sensor: Sensor) -> None:
    """Refuse a sensor that needs to know what is behind what it sees.

    Raises:
        ValueError: with one sentence.
    """
    if sensor.preset not in ("gaussian", "none"):
        raise ValueError(
            "data.sensor.preset must be gaussian or none with data.dataset, whose pictures are measured already; got "
            f"{sensor.preset!r}"
        )


class TruthOfScenes(Sequence[GroundTruth]):
    """Poses and visibility of scenes; a file is read when its scene is asked for, and kept."""

    def __init__(self, dataset: Dataset, names: Sequence[str]) -> None:
        self._dataset, self._names = dataset, names
        self._ground_truth: dict[int, GroundTruth] = {}

    def __len__(self) -> int:
        return len(self._names)

    @overload
    def __getitem__(self, index: int) -> GroundTruth: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[GroundTruth]: ...
    def __getitem__(self, index: int | slice) -> GroundTruth | Sequence[GroundTruth]:
        if isinstance(index, slice):
            return TruthOfScenes(self._dataset, self._names[index])
        if index not in self._ground_truth:
            self._ground_truth[index] = self._dataset.ground_truth(self._names[index])
        return self._ground_truth[index]


@dataclass(frozen=True, eq=False)
class DatasetSplit:
    """Scenes of one part in a dataset.

    Args:
        dataset: with poses.
        names: of its scenes, whole drop cycles.
        part: in the frame of the poses.
    """

    dataset: Dataset
    names: tuple[str, ...]
    part: Part

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def records(self) -> TruthOfScenes:
        """Poses and visibility of every scene."""
        return TruthOfScenes(self.dataset, self.names)

    @cached_property
    def cycles(self) -> dict[str, str]:
        """Sha256 of the poses and visibility of every drop cycle, by its name, as the files say them."""
        hashes: dict[str, hashlib._Hash] = {}
        for name in self.names:
            content = self.dataset.truth_bytes(name)
            cycle = hashes.setdefault(self.dataset.cycle_of(name), hashlib.sha256())
            cycle.update(f"{len(content)} ".encode() + content)
        return {name: cycle.hexdigest() for name, cycle in hashes.items()}

    @property
    def cycle_of_scene(self) -> NDArray[np.int64]:
        """``(S,)`` which drop cycle each scene is of, numbered in the order of their names."""
        cycle_names = [self.dataset.cycle_of(name) for name in self.names]
        return np.unique(cycle_names, return_inverse=True)[1]

    @cached_property
    def digest(self) -> str:
        """Sha256 of names, poses, visibility and cameras of all scenes; pictures are not read for it."""
        h = hashlib.sha256(f"{self.dataset.format} {len(self.names)} {self.names}".encode())
        h.update(" ".join(self.cycles.values()).encode())
        for rule in dict.fromkeys(map(self.dataset.picture_rule, self.names)):
            h.update(rule.encode())
        if not self.dataset.has_labels:  # then the part's surface decides whose the points are
            h.update(self.part.digest.encode())
        return h.hexdigest()

    @property
    def fingerprint(self) -> str:
        """The beginnings of the digests of all drop cycles, one after the other: what a model card keeps."""
        return "".join(digest[:SHORT] for digest in self.cycles.values())


@dataclass(frozen=True)
class DatasetSensing:
    """Makes the clouds of a dataset's scenes; a worker builds the part's surface for its first one.

    Args:
        dataset: the dataset.
        part: in the frame of the poses.
        sensor: ``gaussian`` or ``none``.
        density: most points of a cloud.
    """

    dataset: Dataset
    part: Part
    sensor: Sensor
    density: int

    def __call__(self, name: str) -> tuple[Scene, np.random.Generator]:
        """A scene of that name, up to ``density`` points, and the scene's own random numbers after it.

        Raises:
            ValueError: with one sentence, when a file breaks a rule of the format, or nothing tells the parts' points.
        """
        frame = self.dataset.frame(name)
        scene = self.dataset.scene_of(name, frame)
        points, ids = scene.points, scene.instance_ids
        if not self.dataset.has_labels:
            if not frame.knows_background:
                raise ValueError(
                    f"{self.dataset.directory}: scene {name} must have labels or a picture of the empty bin to train "
                    "on it, got neither"
                )
            points = points[: self.density]
            ids = self._surface.owners(points, scene.camera_from_part)
        elif not frame.knows_background:
            of_parts = ids != BACKGROUND
            points, ids = points[of_parts], ids[of_parts]
        points, ids = points[: self.density], ids[: self.density]
        rng = np.random.default_rng([zlib.crc32(name.encode()), 1])  # the name alone has ordered the points
        if self.sensor.preset == "gaussian":
            noise = rng.normal(scale=self.sensor.sigma_mm / 1000, size=points.shape)
            points = (points + noise).astype(np.float32)
        return replace(scene, points=points, instance_ids=ids), rng

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_surface"}

    @cached_property
    def _surface(self) -> PartSurface:
        return PartSurface(self.part)
