"""The Lightning module: steps, schedule, optimiser, validation, pictures."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch
import trimesh
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging
from tiny_network import BRICK_CHANGES, tiny_network
from torch.utils.data import DataLoader

from attentionvote.data.samples import Batch, collate, draw_sample
from attentionvote.geometry.pose import apply, matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part
from attentionvote.scene import Scene
from attentionvote.training.losses import AttentionVoteLoss
from attentionvote.training.module import PoseTraining
from attentionvote.training.pictures import ScenePictures, picture_inputs
from attentionvote.training.schedule import Schedule
from attentionvote.training.settings import LossSettings

WEIGHTS = {
    "vote": 2.0,
    "vote_rotation": 0.5,
    "center": 1.0,
    "rotation": 1.0,
    "semantic": 0.1,
    "confidence": 1.0,
    "refined": 1.0,
}


@pytest.fixture(scope="session")
def brick() -> Part:
    mesh = trimesh.creation.box((0.06, 0.04, 0.02))
    return Part("brick", np.array(mesh.vertices), np.array(mesh.faces), 0.075)


@pytest.fixture(scope="session")
def bricks(brick: Part) -> Callable[..., Batch]:
    """A batch of scenes of ``count`` bricks seen from all sides."""

    def make(scenes: int = 3, count: int = 3, seed: int = 0) -> Batch:
        rng, layout = np.random.default_rng(seed), tiny_network(**BRICK_CHANGES).layout
        samples = []
        for _ in range(scenes):
            place = np.array([0, 0, 0.5]) + rng.uniform(-0.1, 0.1, (count, 3))
            poses = transform(matrix_from_quaternion(random_quaternion(rng, (count,))), place)
            ids = rng.integers(0, count, 300).astype(np.int32)
            on_part = brick.surface_points(300, rng)
            points = np.stack([apply(poses[i], p[None])[0] for i, p in zip(ids, on_part, strict=True)])
            normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
            scene = Scene(
                points.astype(np.float32), ids, poses, np.ones(count), np.zeros(count, np.int32),
                normals.astype(np.float32),
            )  # fmt: skip
            samples.append(draw_sample(scene, 128, layout, None, rng))
        return collate(samples)

    return make


@pytest.fixture
def make_module(brick: Part) -> Callable[..., PoseTraining]:
    """A module with the same weights every time."""

    def make(network: dict[str, Any] | None = None, **settings: Any) -> PoseTraining:
        model = tiny_network(**(BRICK_CHANGES | (network or {})))
        loss = AttentionVoteLoss(brick, WEIGHTS, LossSettings())
        chosen = {
            "optimizer": "adamw", "learning_rate": 0.003, "weight_decay": 0.01, "peak_threshold": 0.0,
            "train_heat": 0.0, "schedule": Schedule("constant", vote_steps=1, ramp_steps=2, vote_radius_factor=1.5),
        } | settings  # fmt: skip
        return PoseTraining(model, loss, brick, **chosen)

    return make


class Batches(L.LightningDataModule):
    def __init__(self, train: list[Batch], val: list[Batch]) -> None:
        super().__init__()
        self.batches = train, val

    def train_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.batches[0], batch_size=None)  # type: ignore[arg-type]

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.batches[1], batch_size=None)  # type: ignore[arg-type]

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        del dataloader_idx
        return batch.to(device)


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.ERROR)
    yield
    logger.setLevel(level)


def fit(
    module: PoseTraining,
    data: Batches,
    *callbacks: Callback,
    epochs: int = 2,
    precision: Any = "32-true",
    clip: float | None = 5.0,  # a part of every training; not every optimizer allows it in every precision
    log_every: int = 50,
) -> L.Trainer:
    trainer = L.Trainer(
        accelerator="cpu", max_epochs=epochs, logger=False, callbacks=list(callbacks), enable_progress_bar=False,
        enable_checkpointing=False, enable_model_summary=False, num_sanity_val_steps=0, precision=precision,
        gradient_clip_val=clip, log_every_n_steps=log_every,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*LeafSpec.*")
        trainer.fit(module, data)
    return trainer


@pytest.fixture
def data(bricks: Callable[..., Batch]) -> Batches:
    return Batches([bricks(seed=i) for i in range(2)], [bricks(seed=9)])


class Watch(Callback):
    """What every step saw."""

    def __init__(self) -> None:
        self.radius: list[float] = []
        self.terms: list[set[str]] = []
        self.weights: list[torch.Tensor] = []

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, PoseTraining)
        self.radius.append(pl_module.model.voting_radius)
        self.terms.append({k for k in trainer.callback_metrics if k.startswith("train/loss/")})

    def on_validation_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        del trainer
        assert isinstance(pl_module, PoseTraining)
        self.radius.append(pl_module.model.voting_radius)
        self.weights.append(next(pl_module.model.backbone.parameters()).detach().clone())


def test_the_warm_up_trains_votes_in_a_larger_radius(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    module, watch = make_module(), Watch()
    radius = module.model.voting_radius
    fit(module, data, watch)
    # Two steps and a validation an epoch; the votes alone in step 0, ramp 1/2 in step 1, everything from step 2 on.
    assert watch.radius == pytest.approx([1.5 * radius, 1.5 * radius, radius, radius, radius, radius])
    assert watch.terms[0] == {"train/loss/vote", "train/loss/vote_rotation"}
    assert "train/loss/refined" in watch.terms[3]
    module.model.voting_radius = 17.0
    module.detect(data.batches[1][0])
    assert module.model.voting_radius == radius  # inference never looks further


class Norms(Callback):
    """The norm of the gradients before they are clipped, what is logged of it, and the rate of the step."""

    def __init__(self) -> None:
        self.before: list[float] = []
        self.logged: list[float] = []
        self.rates: list[float] = []
        self.steps: list[float] = []

    def on_before_optimizer_step(self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: Any) -> None:
        del trainer
        gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
        self.before.append(float(torch.sqrt(sum((g.double() ** 2).sum() for g in gradients))))  # type: ignore[arg-type]
        self.steps.append(optimizer.param_groups[0]["lr"])

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        self.logged.append(float(trainer.callback_metrics["train/gradient_norm"]))
        self.rates.append(float(trainer.callback_metrics["train/learning_rate"]))


@pytest.mark.parametrize("clip", [1e-3, None, 0.0])
def test_norm_and_rate_are_logged_and_steps_stay_lightning_s(
    make_module: Callable[..., PoseTraining], data: Batches, clip: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, norms = make_module(schedule=Schedule("cosine", vote_steps=1)), Norms()
    fit(module, data, norms, clip=clip, log_every=1)
    assert norms.logged == pytest.approx(norms.before, rel=1e-5)
    assert norms.rates == norms.steps  # to the last digit
    assert norms.rates[0] == 0.003
    assert norms.rates[-1] < norms.rates[0]
    monkeypatch.delattr(PoseTraining, "configure_gradient_clipping")
    plain = make_module(schedule=Schedule("cosine", vote_steps=1))
    fit(plain, data, clip=clip)
    for ours, theirs in zip(module.parameters(), plain.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_training_lowers_the_loss(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    losses = []

    class Losses(Callback):
        def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
            losses.append(float(trainer.callback_metrics["train/loss/vote"]))

    votes_only = Schedule("constant", vote_steps=1000)
    fit(make_module(learning_rate=0.01, schedule=votes_only), data, Losses(), epochs=12)
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:4])


def test_validation_logs_average_precision(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    trainer = fit(make_module(), data, epochs=1)
    metrics = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/")}
    three = [metrics[f"val/ap_{k}"] for k in (10, 5, 2)]
    assert metrics["val/ap"] == pytest.approx(sum(three) / 3)
    assert "val/recall_10" in metrics


def test_weight_decay_spares_biases_and_norms(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    module = make_module()
    trainer = fit(module, data, epochs=1)
    decayed, plain = trainer.optimizers[0].param_groups
    assert (decayed["weight_decay"], plain["weight_decay"]) == (0.01, 0.0)
    assert {p.ndim for p in plain["params"]} <= {0, 1}
    assert len(decayed["params"]) + len(plain["params"]) == len(list(module.parameters()))
    assert isinstance(trainer.optimizers[0], torch.optim.AdamW)


def test_the_paper_s_step_decay_counts_epochs(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    rates = []

    class Rates(Callback):
        def on_train_batch_start(self, trainer: L.Trainer, *_: Any) -> None:
            rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    module = make_module(optimizer="adam", learning_rate=0.001, schedule=Schedule("step", (1, 2), 0.1))
    fit(module, data, Rates(), epochs=3)
    assert rates == pytest.approx([1e-3, 1e-3, 1e-4, 1e-4, 1e-5, 1e-5])


def test_half_precision_reaches_the_metrics(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    # The refinement picks its points in numpy on a CPU, which has no half precision.
    module = make_module({"refinement": None})
    trainer = fit(module, data, epochs=1, precision="bf16-mixed")
    assert 0 <= float(trainer.callback_metrics["val/ap_10"]) <= 1


def test_validation_sees_the_averaged_weights(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    module, watch = make_module(), Watch()
    average = EMAWeightAveraging(decay=0.9999, use_buffers=True)
    fit(module, data, watch, average)
    plain = Watch()
    fit(make_module(), data, plain)
    moved, plainly = (float((w.weights[1] - w.weights[0]).abs().max()) for w in (watch, plain))
    assert plainly > 1e-3  # two steps at a rate of 0.003
    assert moved < 1e-2 * plainly


def test_pictures_come_at_their_time_and_survive_a_resume(
    make_module: Callable[..., PoseTraining], data: Batches
) -> None:
    drawn: list[tuple[int, int]] = []
    pictures = ScenePictures(lambda scene, step, inputs: drawn.append((scene, step)), scenes=2, share=0.5)  # noqa: ARG005
    fit(make_module(), data, pictures, epochs=6)  # 12 steps, a validation every 2
    assert drawn == [(0, 2), (1, 2), (0, 8), (1, 8)]
    again = ScenePictures()
    again.load_state_dict(pictures.state_dict())
    assert again.next_step == 14
    fit(make_module(), data, ScenePictures(), epochs=1)  # nobody draws


def test_a_picture_s_inputs_are_what_was_detected(make_module: Callable[..., PoseTraining], data: Batches) -> None:
    module, batch = make_module().eval(), data.batches[1][0]
    results = module.detect(batch)
    threshold = float(np.median(results[0].scores))
    inputs = list(picture_inputs(module, batch, threshold))
    assert len(inputs) == 3
    kept = results[0].scores >= threshold
    np.testing.assert_array_equal(inputs[0]["predicted_poses"], results[0].poses[kept])
    assert len(inputs[0]["correct"]) == kept.sum()
    assert inputs[0]["votes"].shape == (24, 3)
    assert inputs[0]["heat"].shape == (24,)
    np.testing.assert_allclose(inputs[0]["gt_centers"], batch.center[0].numpy(), atol=1e-6)
