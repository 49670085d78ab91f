"""Batches of a part's scenes for training and validation, reproducible from the seed alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, Sampler

from attentionvote.data.augmentation import Augmentation
from attentionvote.data.clouds import Clouds
from attentionvote.data.samples import Batch, collate, collate_narrow, draw_sample
from attentionvote.model.neighborhoods import Layout
from attentionvote.scene import Scene


class Scenes(Protocol):
    """Measured scenes by number, with normals: ``Clouds``, a list of ``Scene``, or a dataset class of the user's."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Scene: ...


class CloudSamples(Dataset[Batch]):
    """Samples of measured clouds; an item is named by (epoch, scene), which seeds everything random in it.

    So a sample does not depend on which worker draws it, or on what was drawn before: a continued training sees
    what an uninterrupted one would have seen.
    """

    def __init__(
        self, clouds: Scenes, points: int, layout: Layout, augmentation: Augmentation | None, seed: int
    ) -> None:
        self.clouds, self.points, self.layout = clouds, points, layout
        self.augmentation, self.seed = augmentation, seed
        count = clouds.count if isinstance(clouds, Clouds) else lambda i: len(clouds[i].points)
        self.scenes = [i for i in range(len(clouds)) if count(i) >= 3]

    @property
    def cycles(self) -> NDArray[np.int64]:
        """``(S,)`` which drop cycle each scene is of; where nobody knows, each is its own."""
        if not isinstance(self.clouds, Clouds):
            return np.arange(len(self.scenes))
        return self.clouds.cycle_of_scene[self.scenes]

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, item: int | tuple[int, int]) -> Batch:
        epoch, index = item if isinstance(item, tuple) else (0, item)
        rng = np.random.default_rng([self.seed, epoch, index])
        return draw_sample(self.clouds[self.scenes[index]], self.points, self.layout, self.augmentation, rng)


class EpochSampler(Sampler[tuple[int, int]]):
    """(epoch, scene) in an order that depends on the seed and the epoch only; Lightning calls ``set_epoch``.

    Args:
        size: scenes.
        seed: of the order.
        batch_size: scenes a step, of all processes together; what fills no whole batch is left out.
        rank, processes: which share of every batch this process gets.
    """

    def __init__(self, size: int, seed: int, batch_size: int = 1, rank: int = 0, processes: int = 1) -> None:
        self.size, self.seed, self.epoch = size, seed, 0
        self.batch_size, self.rank, self.processes = batch_size, rank, processes

    def set_epoch(self, epoch: int) -> None:
        """Which epoch the next pass is."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.size // self.batch_size * (self.batch_size // self.processes)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.size)
        whole = order[: self.size // self.batch_size * self.batch_size]
        share = whole.reshape(-1, self.processes, self.batch_size // self.processes)[:, self.rank]
        return ((self.epoch, int(index)) for index in share.flatten())


def scene_share(size: int, rank: int, processes: int) -> range:
    """The scenes of ``size`` that a process looks at: each exactly once over all, in order, the first has the most."""
    first, last = (-(-size * r // processes) for r in (rank, rank + 1))
    return range(first, last)


class PartDataModule(L.LightningDataModule):
    """Training, validation and test batches of one part.

    Args:
        train, val, test: measured scenes, of piles that share no drop cycle.
        points: N, points a sample.
        layout: of the network, for the neighbourhoods.
        batch_size: scenes a step, of all processes together.
        workers: loader processes of each process.
        augmentation: of training samples.
        seed: of everything random.
        rank, processes: which share of every batch, and of the other scenes, this process gets. The shares of all
            make the batches of one process, in its order.
        on_gpu: whether batches go to a GPU: they are then made in memory that it copies from by itself.

    Raises:
        ValueError: when there are too few points or scenes.
    """

    def __init__(
        self,
        train: Scenes,
        val: Scenes,
        test: Scenes,
        points: int,
        layout: Layout,
        batch_size: int,
        workers: int,
        augmentation: Augmentation,
        seed: int,
        rank: int = 0,
        processes: int = 1,
        on_gpu: bool = False,
    ) -> None:
        super().__init__()
        if points < layout.centers[0]:
            raise ValueError(f"points must be at least {layout.centers[0]} (centres of the first level), got {points}")
        self.train = CloudSamples(train, points, layout, augmentation, seed)
        self.val = CloudSamples(val, points, layout, None, seed)
        self.test = CloudSamples(test, points, layout, None, seed)
        for name, samples in (("training", self.train), ("validation", self.val), ("test", self.test)):
            if not len(samples):
                where = f" in {samples.clouds.directory}" if isinstance(samples.clouds, Clouds) else ""
                raise ValueError(
                    f"the {name} scenes must have points, but all {len(samples.clouds)} clouds{where} are empty"
                )
            if len(samples) < processes:
                raise ValueError(f"processes must be at most the {len(samples)} {name} scenes, got {processes}")
        if len(self.train) < batch_size:
            raise ValueError(f"batch_size must be at most the {len(self.train)} training scenes, got {batch_size}")
        if batch_size % processes:
            raise ValueError(f"batch_size must be a multiple of the {processes} processes, got {batch_size}")
        self.batch_size, self.workers, self.seed = batch_size, workers, seed
        self.rank, self.processes = rank, processes
        self.first_epoch = 0
        self.form: dict[str, Any] = {"collate_fn": collate_narrow if on_gpu else collate, "pin_memory": on_gpu}

    def train_dataloader(self) -> DataLoader[Batch]:
        """Shuffled, augmented, full batches only; this process's share of each."""
        sampler = EpochSampler(len(self.train), self.seed, self.batch_size, self.rank, self.processes)
        # Lightning opens the loader, whose processes fetch ahead, before it tells the sampler the epoch: without this a
        # continued training would see the samples of epoch 0 again.
        sampler.set_epoch(self.first_epoch)
        return DataLoader(
            self.train,
            batch_size=self.batch_size // self.processes,
            sampler=sampler,
            **self.form,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
            prefetch_factor=4 if self.workers else None,
            drop_last=True,
        )

    def val_dataloader(self) -> DataLoader[Batch]:
        """This process's share of the validation scenes, always the same samples."""
        return self._plain(self.val)

    def test_dataloader(self) -> DataLoader[Batch]:
        """This process's share of the test scenes, always the same samples."""
        return self._plain(self.test)

    def state_dict(self) -> dict[str, Any]:
        """The epoch with which a continued training begins, kept in every checkpoint."""
        assert self.trainer is not None
        return {"epoch": int(self.trainer.fit_loop.epoch_progress.current.processed)}  # type: ignore[attr-defined]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Begin there; Lightning calls it before it opens a loader."""
        self.first_epoch = int(state_dict["epoch"])

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Neighbourhoods are nested tuples, which Lightning would rebuild as lists."""
        del dataloader_idx
        return batch.to(device)

    def _plain(self, samples: CloudSamples) -> DataLoader[Batch]:
        share = scene_share(len(samples), self.rank, self.processes)
        size = self.batch_size // self.processes
        return DataLoader(samples, batch_size=size, sampler=share, num_workers=0, **self.form)
