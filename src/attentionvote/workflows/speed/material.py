"""What the rows of ``make bench`` work on, made once: a settled pile, its clouds, networks with random weights."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.sensing import CloudSettings, measure, sense
from attentionvote.part import Parts
from attentionvote.scene import Scene
from attentionvote.simulation.raycast import PartCaster
from attentionvote.simulation.scene_record import SceneRecord
from attentionvote.simulation.scene_set import generate_scene_set
from attentionvote.simulation.scene_spec import SceneSetSpec, scene_set_specs
from attentionvote.workflows.train.network import described, network_arguments
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.contract import ModelCard
    from attentionvote.data.samples import Batch
    from attentionvote.model.network import AttentionVote

WORKING_POINT = 0.0  # of networks with random weights: every pose is an answer


class Material:
    """Everything is made when it is first asked for, from one seed.

    Weights are random: what a network costs depends on its sizes, not on what it has learned. A context, because
    measured clouds lie in a folder of their own.

    Args:
        part: in the bin.
        trainings: configuration of a training by size, ``compact`` and ``full``.
        batch: scenes a step, by size.
        seed: of everything random.
    """

    def __init__(
        self, part: Parts, trainings: Mapping[str, TrainSettings], batch: Mapping[str, int], seed: int
    ) -> None:
        self.part, self.trainings, self.batch_size, self.seed = part, trainings, batch, seed
        self._folder = tempfile.TemporaryDirectory(prefix="attentionvote-bench-")
        self.folder = Path(self._folder.name)
        for name in ("cloud_settings", "scene", "network", "batch", "card", "graph"):
            setattr(self, name, cache(getattr(self, name)))

    def __enter__(self) -> Material:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def rng(self) -> np.random.Generator:
        """Fresh random numbers, always the same."""
        return np.random.default_rng(self.seed)

    @cached_property
    def caster(self) -> PartCaster:
        """Of the part."""
        return PartCaster(self.part)

    @cached_property
    def cycle(self) -> SceneSetSpec:
        """The training scenes of the full size, one cycle."""
        return replace(scene_set_specs(self.part, self.trainings["full"].simulation)["train"], cycles=1, seed=self.seed)

    @cached_property
    def records(self) -> list[SceneRecord]:
        """The last pile of a cycle, alone.

        Raises:
            ValueError: when the bin was full before.
        """
        last = replace(self.cycle, drop_counts=self.cycle.drop_counts[-1:])
        self._scenes = generate_scene_set(self.part, last, self.folder / "scenes", progress=False)
        records = list(self._scenes.records)
        if not records:
            raise ValueError(
                f"a bin must hold {last.drop_counts[-1]} parts of {self.part.name}, got fewer: choose another"
            )
        return records

    @property
    def record(self) -> SceneRecord:
        """The crowded pile."""
        return self.records[-1]

    def cloud_settings(self, size: str) -> CloudSettings:
        """What the sensor measures."""
        data = self.trainings[size].data
        return CloudSettings(data.sensor, data.density, data.pool, data.normal_neighbors)

    def sensed(self, points: int) -> NDArray[np.float32]:
        """``(points,)`` points of the pile as the sensor delivers them, repeated where the picture has no more."""
        settings = self.cloud_settings("full")
        cloud = sense(self.record, self.caster, replace(settings, density=points, pool=min(points, settings.pool)))[
            0
        ].points
        return np.ascontiguousarray(cloud[np.arange(points) % len(cloud)])

    def scene(self, size: str) -> Scene:
        """The pile as the network's samples are drawn from."""
        return measure(self.record, self.caster, self.cloud_settings(size))

    def stored(self, size: str) -> Clouds:
        """The same on disk."""
        assert self.records
        return measure_clouds(
            self._scenes, self.part, self.cloud_settings(size), self.folder / "clouds", 1, progress=False
        )

    def network(self, size: str) -> AttentionVote:
        """The network of a size in evaluation."""
        import torch

        from attentionvote.model.network import AttentionVote

        torch.manual_seed(self.seed)
        model = AttentionVote.from_arguments(network_arguments(self.trainings[size].model, self.part))
        return model.eval()

    def batch(self, size: str, scenes: int | None = None) -> Batch:
        """Samples of the pile, each turned its own way."""
        from attentionvote.data.samples import collate, draw_sample

        cfg, rng = self.trainings[size], self.rng()
        layout, motion = self.network(size).layout, cfg.data.augmentation
        count = scenes or self.batch_size[size]
        return collate([draw_sample(self.scene(size), cfg.data.points, layout, motion, rng) for _ in range(count)])

    def card(self, size: str) -> ModelCard:
        """What a cell knows of the network."""
        from attentionvote.export.checkpoint_card import model_card

        cfg, points = self.trainings[size], self.record.camera_from_part[:, :3, 3]
        near, far = float(points[:, 2].min()), float(points[:, 2].max())
        metadata = {
            **described(self.part),
            "points": cfg.data.points,
            "clouds": asdict(self.cloud_settings(size)),
            "peak_threshold": 0.0,
            "confidence_threshold": WORKING_POINT,
            "data": {},
            "test": {},
        }
        extent = float(np.ptp(points, axis=0).max()) + self.part.diameter
        return model_card(self.network(size), metadata, self.part, (near - 0.2, far + 0.2), extent)

    def graph(self, size: str) -> bytes:
        """The network's exported graph."""
        from attentionvote.export.onnx_file import export_graph

        return export_graph(self.network(size), self.card(size))
