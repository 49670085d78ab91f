"""The Lightning shell around the network: steps, optimiser, validation by average precision."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import lightning as L
import numpy as np
import torch
from lightning.pytorch.plugins.precision import MixedPrecision
from numpy.typing import NDArray
from torch import Tensor

from attentionvote.data.samples import Batch, collate, draw_sample
from attentionvote.data.sensing import CloudSettings, unlabelled, with_normals
from attentionvote.evaluation import SceneResult, evaluate
from attentionvote.model.network import AttentionVote
from attentionvote.model.predictions import Predictions
from attentionvote.part import Parts
from attentionvote.section import Factory
from attentionvote.training import processes
from attentionvote.training.checkpoint import KEY, load_trained
from attentionvote.training.detections import scene_results
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.optimization import clip_gradient, optimizer_of, paper_rate
from attentionvote.training.proposal_counts import ProposalCounts, proposal_counts
from attentionvote.training.schedule import RateSchedule, Schedule
from attentionvote.training.step import batch_loss


class PoseTraining(L.LightningModule):
    """Trains one network for one part, or for the parts of a set.

    Args:
        model: the network.
        loss: its losses; None of a loaded module, which only answers (so the next two).
        part: for the metrics; or the set of parts that the network's classes are.
        schedule: learning rate and warm-up.
        optimizer: ``adam`` (the paper's), ``adamw``, ``muon`` or another.
        learning_rate, weight_decay: of the optimiser.
        rate_schedule: learning rate instead of the schedule's.
        peak_threshold: heat a proposal needs to count at validation (paper: 0.4).
        train_heat: heat a proposal needs to be trained on.
        metadata: plain values that every checkpoint carries, see ``checkpoint.load_trained``.
    """

    def __init__(
        self,
        model: AttentionVote,
        loss: AttentionVoteLoss | None,
        part: Parts | None,
        schedule: Schedule | None,
        optimizer: str | Factory = "adam",
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        peak_threshold: float = 0.4,
        train_heat: float = 0.1,
        metadata: Mapping[str, Any] | None = None,
        rate_schedule: RateSchedule | None = None,
    ) -> None:
        super().__init__()
        if part is not None and model.classes != len(part.parts):
            raise ValueError(
                f"model.classes must be the number of parts of {part.name} ({len(part.parts)}), got {model.classes}"
            )
        self.metadata = dict(metadata or {})
        self.model = model
        # None of a loaded module, which only answers: see configure_optimizers.
        self.loss: AttentionVoteLoss = loss  # type: ignore[assignment]
        self.part: Parts = part  # type: ignore[assignment]
        self.schedule: Schedule = schedule  # type: ignore[assignment]
        self.optimizer, self.learning_rate, self.weight_decay = optimizer, learning_rate, weight_decay
        self.peak_threshold, self.train_heat = peak_threshold, train_heat
        self.rate_schedule = rate_schedule
        self.voting_radius = model.voting_radius
        self.results: list[SceneResult] = []

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: Path | str, **_: Any) -> Self:  # type: ignore[override]
        """A trained module of ``model.ckpt`` or of any checkpoint of its training, for answers alone.

        Raises:
            ValueError, FileNotFoundError: see ``checkpoint.load_trained``.
        """
        model, metadata = load_trained(checkpoint_path)
        module = cls(model, None, None, None, peak_threshold=metadata["peak_threshold"], metadata=metadata)
        return module.eval()

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """One step; logs every term of the loss under ``train/loss/``, and ``train/learning_rate``."""
        ramp = self.schedule.ramp(self.global_step)
        self.model.voting_radius = self.voting_radius * (self.schedule.vote_radius_factor if ramp < 1 else 1.0)
        terms = batch_loss(self.model, self.loss, batch, ramp, self.train_heat)
        total = self.loss.total(terms, ramp)
        whole = processes.summed(torch.stack([*terms.values(), total]))
        names = [*(f"train/loss/{k}" for k in terms), "train/loss"]
        self.log_dict(dict(zip(names, whole, strict=True)), batch_size=len(batch.points))
        rate = self.trainer.optimizers[0].param_groups[0]["lr"]
        self.log("train/learning_rate", torch.as_tensor(rate, dtype=torch.float64), batch_size=len(batch.points))
        # The gradients of several processes are averaged, but their parts of the loss add up.
        return total * processes.count()

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradients by their norm, and log it as it was before: ``train/gradient_norm``."""
        most, precision = gradient_clip_val or 0.0, self.trainer.precision_plugin
        mixed = isinstance(precision, MixedPrecision) and getattr(optimizer, "_step_supports_amp_scaling", False)
        if most and mixed:  # Lightning refuses it, in words of its own
            self.clip_gradients(optimizer, most, gradient_clip_algorithm)
        every: int = self.trainer.log_every_n_steps  # type: ignore[attr-defined]  # Lightning declares it nowhere
        if most or (self.global_step + 1) % every == 0:  # a norm for nothing costs time
            self.log("train/gradient_norm", clip_gradient(precision.main_params(optimizer), most))

    def on_validation_epoch_start(self) -> None:
        """Nothing is found yet."""
        self.results = []

    def validation_step(self, batch: Batch, _: int) -> None:
        """Collect the detections of a batch."""
        self.results += self.detect(batch)

    def on_validation_epoch_end(self) -> None:
        """Average precision at 10, 5 and 2 % of the diameter over all validation scenes, those of all processes.

        Of several parts the mean over the parts, and each part's own.
        """
        results = processes.in_order(self.results)
        metrics = processes.from_first(evaluate(results, self.part, add=False) if processes.rank() == 0 else {})
        self.log_dict({f"val/{k}": v for k, v in metrics.items()})
        self.log("val/ap", (metrics["ap_10"] + metrics["ap_5"] + metrics["ap_2"]) / 3)

    @torch.no_grad()
    def predict(self, batch: Batch) -> Predictions:
        """What the network answers; never with the larger radius of the warm-up."""
        self.model.voting_radius = self.voting_radius
        batch = self.fitting(batch)
        predictions: Predictions = self.model(batch.points, batch.normals, batch.neighborhoods)
        return predictions

    def fitting(self, batch: Batch) -> Batch:
        """The batch on the device and in the precision of the network; a loader's is float32 on the CPU."""
        weight = next(self.model.parameters())
        return batch.to(weight.device, weight.dtype)

    def detect(self, batch: Batch) -> list[SceneResult]:
        """Detections of a batch beside its truth."""
        return scene_results(self.predict(batch), batch, self.peak_threshold)

    def predict_step(self, batch: Batch, _: int = 0) -> list[SceneResult]:
        """``detect``, for ``Trainer.predict``."""
        return self.detect(batch)

    def poses(self, points: NDArray[np.floating], seed: int = 0) -> SceneResult:
        """Every instance in a cloud, as a cell finds it: ``poses`` (camera_from_part, metres) and ``scores``.

        Args:
            points: ``(P, 3)`` camera frame, metres; rows that are not finite are missing.
            seed: of the choice of points.

        Raises:
            ValueError: when fewer than three points are left.
        """
        settings, rng = CloudSettings.of(self.metadata["clouds"]), np.random.default_rng(seed)
        scene = with_normals(unlabelled(points, settings.density, rng), rng, settings)
        batch = collate([draw_sample(scene, int(self.metadata["points"]), self.model.layout, None, rng)])
        threshold = self.metadata["confidence_threshold"] or 0.0
        return scene_results(self.predict(batch), batch, self.peak_threshold, threshold)[0]

    def examine(self, batch: Batch) -> list[tuple[SceneResult, ProposalCounts]]:
        """``detect``, and how the proposals cover the instances within the radius of the loss's assignment."""
        predictions = self.predict(batch)
        radius = [self.loss.settings.assignment * part.diameter for part in self.part.parts]
        counts = proposal_counts(predictions, batch, self.peak_threshold, radius)
        return list(zip(scene_results(predictions, batch, self.peak_threshold), counts, strict=True))

    def configure_optimizers(self) -> Any:
        """The optimizer and its learning rate (``training.optimization``).

        Raises:
            ValueError: of a module that was loaded.
        """
        if self.loss is None:
            raise ValueError("a loaded module only answers: a training begins with its weights by init=FILE")
        fused = str(self.trainer.precision).endswith("-true")
        optimizer = optimizer_of(self.optimizer, self.parameters(), self.learning_rate, self.weight_decay, fused=fused)
        total = int(self.trainer.estimated_stepping_batches)
        if self.rate_schedule is not None:
            every = self.trainer.check_val_every_n_epoch or 1
            return {"optimizer": optimizer, "lr_scheduler": self.rate_schedule.configured(optimizer, total, every)}
        per_epoch = max(1, -(-int(self.trainer.num_training_batches) // self.trainer.accumulate_grad_batches))
        return {"optimizer": optimizer, "lr_scheduler": paper_rate(self.schedule, optimizer, total, per_epoch)}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what is needed to build the network again without the configuration."""
        checkpoint[KEY] = dict(self.metadata)
