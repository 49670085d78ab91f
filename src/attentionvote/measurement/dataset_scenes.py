"""Scenes of somebody else's dataset as something to measure on, once it is sure that the part is the dataset's."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.dataset_split import SHORT, DatasetSplit
from attentionvote.data.part_frame import check_part_frame
from attentionvote.datasets import Dataset, open_datasets
from attentionvote.geometry.pointcloud import sample_indices
from attentionvote.part import Part
from attentionvote.scene import Scene


@dataclass(frozen=True)
class DatasetScenes:
    """The scored scenes of one object of a dataset: see ``measurement.scenes.MeasuredScenes``.

    Args:
        dataset: with poses.
        part: in the dataset's own frame.
        density: most points of a cloud; which ones is decided by the scene's name.
    """

    dataset: Dataset
    part: Part
    density: int

    @classmethod
    def find(cls, folder: Path, part: Part, density: int) -> DatasetScenes:
        """The dataset in a folder, which must be one, of one object, and hold this part.

        Raises:
            ValueError: with one sentence, when it is none or another, or the part's frame is not the dataset's.
        """
        datasets = open_datasets(folder)
        if len(datasets) != 1 or len(datasets[0].parts) != 1:
            held = ", ".join(f"{dataset.title} {dataset.split}" for dataset in datasets) or "none"
            raise ValueError(
                f"{folder} must hold one dataset of one object, got {held}: name the folder of one of them"
            )
        scenes = cls(datasets[0], part, density)
        if not len(scenes):
            raise ValueError(f"{folder} must hold scenes with at least five parts, got {len(datasets[0].names)} others")
        if scenes.dataset.has_labels:
            check_part_frame(next(scenes.clouds()), part, str(scenes.dataset.directory), labelled=True)
        return scenes

    @cached_property
    def digest(self) -> str:
        """Sha256 of the poses of all scenes, the names and the number of points: pictures are not read for it."""
        h = hashlib.sha256(f"{self.dataset.format} {self.dataset.title} {self.dataset.split} {self.density}".encode())
        for name in self.dataset.scored_names:
            truth = self.dataset.ground_truth(name)
            h.update(name.encode())
            h.update(np.round(truth.camera_from_part * 1e6).astype(np.int64).tobytes())
            h.update(np.round(truth.visible_fraction * 1e6).astype(np.int64).tobytes())
        return h.hexdigest()

    @property
    def title(self) -> str:
        """Dataset and split."""
        return f"{self.dataset.title} {self.dataset.split}"

    @property
    def cycle_of_scene(self) -> NDArray[np.int64]:
        """``(S,)`` which drop cycle each scene is of."""
        return self._split.cycle_of_scene

    @cached_property
    def _split(self) -> DatasetSplit:
        return DatasetSplit(self.dataset, self.dataset.scored_names, self.part)

    def __len__(self) -> int:
        return len(self.dataset.scored_names)

    def check_unseen(self, trained_with: Mapping[str, str]) -> None:
        """Whether a model has learned from none of the scenes; those of its test decided nothing.

        Args:
            trained_with: ``data`` of its card.

        Raises:
            ValueError: with one sentence.
        """
        cycle_digests = trained_with.get("cycles", "")
        learned = {cycle_digests[i : i + SHORT] for i in range(0, len(cycle_digests), SHORT)}
        cycles = self._split.cycles
        seen = [name for name, digest in cycles.items() if digest[:SHORT] in learned]
        if self.dataset.written_from in trained_with.values():
            seen = list(cycles)
        if seen:
            raise ValueError(
                f"{self.dataset.directory} must hold scenes that the model was not trained with, but it was with "
                f"{len(seen)} of the {len(cycles)} drop cycles, {seen[0]} for one: name the folder of others"
            )

    def clouds(self) -> Iterator[Scene]:
        """Every scored scene without its background, at most ``density`` points."""
        for name in self.dataset.scored_names:
            scene = self.dataset.scene(name)
            rows = sample_indices(len(scene.points), min(self.density, len(scene.points)), np.random.default_rng(0))
            yield Scene(
                scene.points[rows],
                scene.instance_ids[rows],
                scene.camera_from_part,
                np.clip(scene.visible_fraction, 0.0, 1.0),
                scene.part_ids,
            )
