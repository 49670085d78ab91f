"""Batches depend on the seed, the epoch and the scene only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from attentionvote.data import Augmentation, Batch, Clouds, CloudSettings, PartDataModule, measure_clouds
from attentionvote.data.datamodule import EpochSampler
from attentionvote.model import Layout
from attentionvote.part import Part
from attentionvote.simulation import SceneSet


def module(clouds: Clouds, layout: Layout, workers: int = 0, seed: int = 3, batch_size: int = 2) -> PartDataModule:
    return PartDataModule(clouds, clouds, clouds, 64, layout, batch_size, workers, Augmentation(), seed)


def points(data: PartDataModule, epoch: int) -> list[torch.Tensor]:
    loader = data.train_dataloader()
    assert isinstance(loader.sampler, EpochSampler)
    loader.sampler.set_epoch(epoch)
    return [batch.points for batch in loader]


def test_an_epoch_is_reproducible_and_differs_from_the_next(clouds: Clouds, layout: Layout) -> None:
    first = points(module(clouds, layout), 1)
    assert len(first) == len(clouds) // 2  # full batches only
    assert all(torch.equal(a, b) for a, b in zip(first, points(module(clouds, layout), 1), strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first, points(module(clouds, layout), 2), strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first, points(module(clouds, layout, seed=4), 1), strict=True))


def test_a_loader_process_changes_nothing_over_epochs(clouds: Clouds, layout: Layout) -> None:
    own, loader = module(clouds, layout), module(clouds, layout, workers=1).train_dataloader()
    assert isinstance(loader.sampler, EpochSampler)
    for epoch in (0, 5):
        loader.sampler.set_epoch(epoch)
        drawn = [batch.points for batch in loader]
        assert all(torch.equal(a, b) for a, b in zip(drawn, points(own, epoch), strict=True))


@pytest.mark.parametrize("workers", [0, 1])
def test_a_continued_training_begins_with_its_own_epoch(clouds: Clouds, layout: Layout, workers: int) -> None:
    interrupted, data = module(clouds, layout), module(clouds, layout, workers)
    progress = SimpleNamespace(current=SimpleNamespace(processed=3))
    interrupted.trainer = SimpleNamespace(fit_loop=SimpleNamespace(epoch_progress=progress))  # type: ignore[assignment]
    data.load_state_dict(interrupted.state_dict())
    loader = data.train_dataloader()
    batches = iter(loader)  # Lightning opens the loader before it tells the epoch
    assert isinstance(loader.sampler, EpochSampler)
    loader.sampler.set_epoch(3)
    drawn = [batch.points for batch in batches]
    assert all(torch.equal(a, b) for a, b in zip(drawn, points(module(clouds, layout), 3), strict=True))


def test_every_scene_occurs_once_an_epoch() -> None:
    sampler = EpochSampler(7, seed=1)
    sampler.set_epoch(4)
    items = list(sampler)
    assert sorted(index for _, index in items) == list(range(7))
    assert {epoch for epoch, _ in items} == {4}
    sampler.set_epoch(5)
    assert [index for _, index in sampler] != [index for _, index in items]


def test_validation_is_always_the_same_and_not_augmented(clouds: Clouds, layout: Layout) -> None:
    data = module(clouds, layout)
    first, second = (list(data.val_dataloader()) for _ in range(2))
    assert sum(len(b.points) for b in first) == len(clouds)  # all scenes, the last batch may be smaller
    assert all(torch.equal(a.points, b.points) for a, b in zip(first, second, strict=True))
    truth = torch.tensor(clouds[0].camera_from_part[:, :3, 3], dtype=torch.float32)
    assert torch.equal(first[0].center[0, :1], truth)
    assert isinstance(data.transfer_batch_to_device(first[0], torch.device("cpu"), 0), Batch)


def test_what_cannot_be_trained_on_is_refused(
    clouds: Clouds,
    layout: Layout,
    make_scenes: Callable[..., SceneSet],
    box: Part,
    settings: CloudSettings,
    folder: Path,
) -> None:
    with pytest.raises(ValueError, match="batch_size must be at most the 5 training scenes, got 6"):
        module(clouds, layout, batch_size=6)
    with pytest.raises(ValueError, match=r"points must be at least 32 \(centres of the first level\), got 31"):
        PartDataModule(clouds, clouds, clouds, 31, layout, 2, 0, Augmentation(), 0)
    empty = measure_clouds(make_scenes((1, 2), away=True), box, settings, folder, 1, progress=False)
    with pytest.raises(ValueError, match=r"the validation scenes must have points, but all 2 clouds in .* are empty"):
        PartDataModule(clouds, empty, clouds, 64, layout, 2, 0, Augmentation(), 0)
    mixed = measure_clouds(make_scenes((1, 2)), box, settings, folder, 1, progress=False)
    assert len(PartDataModule(mixed, clouds, clouds, 64, layout, 2, 0, Augmentation(), 0).train) == 2
