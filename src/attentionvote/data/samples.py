"""One training sample, its augmentation, and the batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from attentionvote.data.augmentation import Augmentation
from attentionvote.geometry.pointcloud import sample_indices
from attentionvote.model.neighborhoods import Layout, Neighborhoods, find_neighborhoods, waits_for_nothing
from attentionvote.scene import Scene


class Batch(NamedTuple):
    """Samples with their ground truth; instances are padded to the largest number in the batch.

    Attributes:
        points, normals: ``(batch, N, 3)`` camera frame, metres.
        instance: ``(batch, N)`` instance of each point, -1 for none.
        neighborhoods: of the points.
        center: ``(batch, I, 3)`` origins of the instances, camera frame.
        rotation: ``(batch, I, 3, 3)`` ``camera_from_part``.
        visible: ``(batch, I)`` visible fraction, 0 where padded.
        part: ``(batch, I)`` index of the part.
    """

    points: Tensor
    normals: Tensor
    instance: Tensor
    neighborhoods: Neighborhoods
    center: Tensor
    rotation: Tensor
    visible: Tensor
    part: Tensor

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Batch:
        """The same on another device; real numbers in the precision of ``dtype`` where that is given."""

        def moved(value: Tensor) -> Tensor:
            return value.to(
                device, dtype if value.is_floating_point() else None, non_blocking=waits_for_nothing(device)
            )

        neighborhoods = self.neighborhoods.to(device, dtype)
        return Batch(
            **{name: moved(getattr(self, name)) for name in self._fields if name != "neighborhoods"},
            neighborhoods=neighborhoods,
        )

    def first(self, count: int) -> Batch:
        """Only the first ``count`` samples."""
        neighborhoods = Neighborhoods(
            self.neighborhoods.order[:count],
            *(tuple(level[:count] for level in levels) for levels in self.neighborhoods[1:]),
        )
        return Batch(
            **{name: getattr(self, name)[:count] for name in self._fields if name != "neighborhoods"},
            neighborhoods=neighborhoods,
        )


def draw_sample(
    scene: Scene, count: int, layout: Layout, augmentation: Augmentation | None, rng: np.random.Generator
) -> Batch:
    """A batch of one without the batch dimension: ``count`` random points of a scene, moved, with neighbourhoods.

    Raises:
        ValueError: when the scene is empty or has no normals.
    """
    if scene.normals is None:
        raise ValueError("a scene must have normals before it is sampled, got none: estimate_normals first")
    rows = sample_indices(len(scene.points), count, rng)
    # Rows by take: a fifth of the time of an index in brackets.
    points, normals = scene.points.take(rows, axis=0), scene.normals.take(rows, axis=0)
    poses = scene.camera_from_part
    if augmentation is not None:
        points, normals, poses = augmentation.apply(points, normals, poses, rng)
    return Batch(
        torch.from_numpy(np.ascontiguousarray(points)),
        torch.from_numpy(np.ascontiguousarray(normals)),
        torch.from_numpy(scene.instance_ids[rows].astype(np.int64)),
        find_neighborhoods(points, layout),
        torch.from_numpy(poses[:, :3, 3].astype(np.float32)),
        torch.from_numpy(poses[:, :3, :3].astype(np.float32)),
        torch.from_numpy(scene.visible_fraction.astype(np.float32)),
        torch.from_numpy(scene.part_ids.astype(np.int64)),
    )


def collate_narrow(samples: Sequence[Batch]) -> Batch:
    """``collate`` for a GPU: indices of points have 32 bits until they are there, which halves what is copied."""
    batch = collate(samples)
    return batch._replace(neighborhoods=batch.neighborhoods.narrow())


def collate(samples: Sequence[Batch]) -> Batch:
    """Stack samples; instances are padded with identity rotations, zero centres and visibility 0."""
    most = max(1, *(len(s.center) for s in samples)) if samples else 1

    def padded(name: str, fill: Tensor) -> Tensor:
        rows = []
        for sample in samples:
            value: Tensor = getattr(sample, name)
            rows.append(torch.cat([value, fill.to(value.dtype).expand(most - len(value), *value.shape[1:])]))
        return torch.stack(rows)

    return Batch(
        torch.stack([s.points for s in samples]),
        torch.stack([s.normals for s in samples]),
        torch.stack([s.instance for s in samples]),
        Neighborhoods.stack([s.neighborhoods for s in samples]),
        padded("center", torch.zeros(3)),
        padded("rotation", torch.eye(3)),
        padded("visible", torch.zeros(())),
        padded("part", torch.zeros(())),
    )
