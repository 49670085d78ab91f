"""Numbers for the pictures of fixed validation scenes: votes, heat, poses. Drawing is the tracking's business."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray
from torch import Tensor

from attentionvote.data.samples import Batch
from attentionvote.evaluation import PoseMetric
from attentionvote.training.module import PoseTraining
from attentionvote.training.operating_point import best_threshold

# Draws one picture: number of the scene, step, arguments of ``tracking.scene_pictures.scene_picture``.
Draw = Callable[[int, int, dict[str, Any]], None]


class ScenePictures(Callback):
    """Pictures of the first validation scenes as the training goes on, taken during validation (averaged weights).

    Args:
        draw: called for every picture; None draws nothing.
        scenes: how many.
        share: of the training that lies at least between two pictures of a scene.
    """

    def __init__(self, draw: Draw | None = None, scenes: int = 2, share: float = 0.1) -> None:
        self.draw, self.scenes, self.share = draw, scenes, share
        self.next_step = 0

    def on_validation_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Batch, batch_idx: int, *_: Any
    ) -> None:
        """Draw the first batch's first scenes when it is time."""
        del outputs
        step, total = trainer.global_step, int(trainer.estimated_stepping_batches)
        if self.draw is None or batch_idx > 0 or step < self.next_step or trainer.sanity_checking:
            return
        assert isinstance(pl_module, PoseTraining)
        self.next_step = step + max(1, int(self.share * total))
        threshold = best_threshold(pl_module.results, pl_module.part)
        for i, inputs in enumerate(picture_inputs(pl_module, batch.first(self.scenes), threshold)):
            self.draw(i, step, inputs)

    def state_dict(self) -> dict[str, Any]:
        """When the next pictures are due, for a continued training."""
        return {"next_step": self.next_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        self.next_step = int(state_dict["next_step"])


@torch.no_grad()
def picture_inputs(module: PoseTraining, batch: Batch, confidence_threshold: float) -> Iterator[dict[str, Any]]:
    """For every sample of a batch the arguments of ``tracking.scene_pictures.scene_picture``.

    Args:
        module: the trained module.
        batch: fixed scenes.
        confidence_threshold: detections below it are not drawn.
    """
    batch = module.fitting(batch)
    results = module.detect(batch)
    votes = module.model.cast_votes(batch.points, batch.normals, batch.neighborhoods)
    peaks = module.model.find_peaks(votes)
    parts = module.part.parts
    for i, result in enumerate(results):
        sure = result.above(confidence_threshold)
        correct = np.zeros(len(sure.poses), dtype=bool)
        for k, part in enumerate(parts):
            part_result = sure.of_part(k)
            distances = PoseMetric.of(part).distances(part_result.poses, part_result.gt_poses)
            correct[sure.part_ids == k] = distances.min(axis=1, initial=np.inf) <= 0.1 * part.diameter
        visible = result.gt_occlusion <= 0.5
        yield {
            "points": _array(batch.points[i]),
            "votes": _array(votes.xyz[i]),
            "heat": _array(peaks.vote_heat[i]),
            "peaks": _array(peaks.center_seed[i][peaks.heat[i] >= module.peak_threshold]),
            "gt_centers": result.gt_poses[visible, :3, 3],
            "predicted_poses": sure.poses,
            "correct": correct,
            "gt_poses": result.gt_poses[visible],
            "vertices": [part.vertices for part in parts],
            "faces": [part.faces for part in parts],
            "predicted_parts": sure.part_ids,
            "gt_parts": result.gt_part_ids[visible],
        }


def _array(values: Tensor) -> NDArray[np.float32]:
    return values.detach().float().cpu().numpy()
