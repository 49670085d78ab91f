"""Batches depend on the seed, the epoch and the scene only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from attentionvote.data.augmentation import Augmentation
from attentionvote.data.clouds import Clouds, measure_clouds
from attentionvote.data.datamodule import CloudSamples, EpochSampler, PartDataModule, scene_share
from attentionvote.data.samples import Batch
from attentionvote.data.sensing import CloudSettings
from attentionvote.model.neighborhoods import Layout
from attentionvote.part import Part
from attentionvote.simulation.scene_set import SceneSet


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


def test_samples_know_their_cycle_where_somebody_does(clouds: Clouds, layout: Layout) -> None:
    samples = module(clouds, layout).test
    assert list(samples.cycles) == [0, 0, 1, 1, 2]
    samples.scenes = [1, 2, 4]  # as if the others had no points
    assert list(samples.cycles) == [0, 1, 2]
    own = CloudSamples([clouds[i] for i in range(5)], 64, layout, None, 3)
    assert list(own.cycles) == [0, 1, 2, 3, 4]


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


@pytest.mark.parametrize("processes", [1, 2, 3, 6])
def test_the_shares_of_all_processes_are_the_batches_of_one(processes: int) -> None:
    whole = EpochSampler(32, 5, batch_size=6)
    shares = [EpochSampler(32, 5, 6, rank, processes) for rank in range(processes)]
    for epoch in (0, 3):
        for sampler in (whole, *shares):
            sampler.set_epoch(epoch)
        one, parts = list(whole), [list(share) for share in shares]
        assert len(one) == len(whole) == 30  # five whole batches; the rest is left out, as in one process
        assert {len(part) for part in parts} == {len(shares[0])} == {30 // processes}
        size = 6 // processes
        for step in range(5):
            batch = [item for part in parts for item in part[step * size : (step + 1) * size]]
            assert batch == one[6 * step : 6 * step + 6]


def test_a_process_draws_the_same_samples_as_one_alone(clouds: Clouds, layout: Layout) -> None:
    def of(rank: int, processes: int) -> PartDataModule:
        return PartDataModule(clouds, clouds, clouds, 64, layout, 4, 0, Augmentation(), 3, rank, processes)

    (whole,) = points(of(0, 1), 2)
    parts = [points(of(rank, 2), 2) for rank in range(2)]
    assert torch.equal(torch.cat([part[0] for part in parts]), whole)
    validated = [[batch.points for batch in of(rank, 2).val_dataloader()] for rank in range(2)]
    alone = torch.cat([batch.points for batch in of(0, 1).val_dataloader()])
    assert torch.equal(torch.cat([p for part in validated for p in part]), alone)  # five scenes: 3 and 2
    with pytest.raises(ValueError, match="processes must be at most the 5 training scenes, got 6"):
        PartDataModule(clouds, clouds, clouds, 64, layout, 5, 0, Augmentation(), 3, 0, 6)
    with pytest.raises(ValueError, match="batch_size must be a multiple of the 2 processes, got 3"):
        PartDataModule(clouds, clouds, clouds, 64, layout, 3, 0, Augmentation(), 3, 0, 2)


@pytest.mark.parametrize(("size", "processes"), [(1, 1), (5, 2), (7, 3), (8, 4), (9, 8)])
def test_every_scene_is_looked_at_by_one_process(size: int, processes: int) -> None:
    shares = [scene_share(size, rank, processes) for rank in range(processes)]
    assert [scene for share in shares for scene in share] == list(range(size))
    assert all(shares)  # Lightning does not validate where there is nothing: the others would wait for ever
    assert len(shares[0]) == max(map(len, shares))


@pytest.mark.filterwarnings("ignore:.*pin_memory.*no accelerator")  # of torch, where there is no GPU to pin for
@pytest.mark.parametrize("workers", [0, 1])
def test_batches_for_a_gpu_are_narrow_on_the_way_and_the_same_there(
    clouds: Clouds, layout: Layout, workers: int
) -> None:
    plain = module(clouds, layout, workers)
    for_gpu = PartDataModule(clouds, clouds, clouds, 64, layout, 2, workers, Augmentation(), 3, on_gpu=True)
    assert for_gpu.train_dataloader().pin_memory
    assert for_gpu.val_dataloader().pin_memory
    assert not plain.train_dataloader().pin_memory
    for expected, narrow in zip(plain.train_dataloader(), for_gpu.train_dataloader(), strict=True):
        indices = narrow.neighborhoods.order, *narrow.neighborhoods.neighbors, *narrow.neighborhoods.nearest
        assert {t.dtype for t in indices} == {torch.int32}
        assert_same(expected, narrow.to("cpu"))


def assert_same(expected: Batch, actual: Batch) -> None:
    for name in Batch._fields:
        pair = [getattr(batch, name) for batch in (expected, actual)]
        if name == "neighborhoods":
            assert [type(part) for part in pair[0]] == [type(part) for part in pair[1]]
            pair = [
                torch.cat([t.flatten().double() for t in (n.order, *n.neighbors, *n.nearest, *n.weights)]) for n in pair
            ]
            assert actual.neighborhoods.order.dtype == torch.int64
        assert torch.equal(*pair), name
