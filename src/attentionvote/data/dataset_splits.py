"""Training, validation and test scenes of a dataset: its own splits where a folder holds them, else whole drop cycles.

Only scenes with at least five drops are taken, as the paper counts them (Table 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from attentionvote.data.dataset_split import DatasetSensing, DatasetSplit
from attentionvote.data.part_frame import check_part_frame
from attentionvote.datasets import Dataset, open_datasets
from attentionvote.datasets.recognition import split_of
from attentionvote.part import Part
from attentionvote.simulation.sensor import Sensor

SPLITS = ("train", "val", "test")
_LOOKED_AT = 4_000  # points of the scene whose frame is checked


@dataclass(frozen=True)
class DatasetSplits:
    """What a training takes from a folder.

    Attributes:
        folder: as it was named.
        held_out: share of the drop cycles for validation and test, where there is no such split.
        splits: scenes by ``train``, ``val`` and ``test``; no drop cycle is in two of them.
        origins: by split, where its scenes come from, in words.
    """

    folder: Path
    held_out: Mapping[str, float]
    splits: Mapping[str, DatasetSplit]
    origins: Mapping[str, str]

    @classmethod
    def open(cls, folder: Path, part: Part, held_out: Mapping[str, float]) -> DatasetSplits:
        """The scenes of a part in a folder, which is a dataset's own or holds several splits of it.

        Where the folder holds several objects, those with the part's name are taken. Real pictures are not mixed with
        rendered ones: they are trained on when the folder holds nothing else.

        Args:
            folder: see ``datasets.open_datasets``.
            part: in the frame of the poses.
            held_out: shares for ``val`` and ``test``, each of one drop cycle at least; the last cycles are the test's,
                those before them the validation's.

        Raises:
            ValueError: with one sentence, when the folder is no dataset, or of other or several parts, or cannot be
                split, nothing tells the parts' points from the bin's, or the part's frame is not the dataset's.
        """
        datasets = _by_split(open_datasets(folder), folder, part)
        names = {split: _scored(dataset) for split, dataset in datasets.items()}
        splits = {split: DatasetSplit(dataset, names[split], part) for split, dataset in datasets.items()}
        origins = {split: f"{dataset.title} {dataset.split}, all" for split, dataset in datasets.items()}
        missing = [split for split in SPLITS if split not in splits]
        if missing:
            held = _hold_out(splits["train"], {split: held_out[split] for split in missing})
            for split, cycles in held.items():
                splits[split] = cycles
                whole = f"{splits['train'].dataset.title} {splits['train'].dataset.split}"
                origins[split] = (
                    f"{whole}, {_range_of(list(dict.fromkeys(map(cycles.dataset.cycle_of, cycles.names))))}"
                )
        train = splits["train"]
        scene, _ = DatasetSensing(train.dataset, part, Sensor("none"), _LOOKED_AT)(train.names[0])
        check_part_frame(scene, part, str(train.dataset.directory), train.dataset.has_labels)
        return cls(folder, dict(held_out), {split: splits[split] for split in SPLITS}, origins)

    def __str__(self) -> str:
        return "; ".join(f"{split}: {self.origins[split]}" for split in SPLITS)

    @property
    def evidence(self) -> dict[str, str]:
        """By which a model's card tells scenes that were learned from, beside the digests of the splits.

        ``cycles``: the beginnings of the digests of all drop cycles that decide weights and thresholds, of training and
        validation; ``scene_set``: of the generated scenes that a dataset was written from.
        """
        train, val = self.splits["train"], self.splits["val"]
        origin = train.dataset.written_from
        return {"cycles": train.fingerprint + val.fingerprint} | ({"scene_set": origin} if origin else {})

    def described(self) -> dict[str, Any]:
        """What a checkpoint keeps, plain values: enough to find the scenes again."""
        return {
            "folder": str(self.folder.resolve()),
            "held_out": dict(self.held_out),
            "splits": {
                split: {"from": self.origins[split], "scenes": len(scenes), "cycles": len(scenes.cycles)}
                for split, scenes in self.splits.items()
            },
        }


def _by_split(datasets: Sequence[Dataset], folder: Path, part: Part) -> dict[str, Dataset]:
    """The datasets of the part by ``train``, ``val`` and ``test``; a single one is ``train``, whatever its name."""
    candidates = [dataset for dataset in datasets if dataset.parts == (part.name,)] or list(datasets)
    candidates = [dataset for dataset in candidates if dataset.split != "real"] or candidates
    held = ", ".join(f"{dataset.title} {dataset.split}" for dataset in candidates)
    if len({(dataset.format, dataset.parts) for dataset in candidates}) != 1 or len(candidates[0].parts) != 1:
        several = len(candidates) == 1
        got = f"{held} of the parts {', '.join(candidates[0].parts)}" if several else held
        raise ValueError(
            f"{folder} must hold a dataset of one part, {part.name}, to train on, got {got}: name the folder of one"
        )
    if len(candidates) == 1:
        return {"train": candidates[0]}
    by_split = {
        split: [dataset for dataset in candidates if split_of(Path(dataset.split)) == split] for split in SPLITS
    }
    if not by_split["train"] or any(len(datasets) > 1 for datasets in by_split.values()):
        raise ValueError(
            f"{folder} must hold one dataset to train on and at most one for val and for test, got {held}: name the "
            "folder of one of them"
        )
    return {split: datasets[0] for split, datasets in by_split.items() if datasets}


def _scored(dataset: Dataset) -> tuple[str, ...]:
    names = dataset.scored_names
    if not names:
        raise ValueError(
            f"{dataset.directory} must hold scenes with at least five parts, got {len(dataset.names)} others"
        )
    return names


def _hold_out(scenes: DatasetSplit, shares: Mapping[str, float]) -> dict[str, DatasetSplit]:
    """Whole cycles from the end, the test's last; what is left is ``train``."""
    cycles = [list(names) for _, names in groupby(scenes.names, key=scenes.dataset.cycle_of)]
    counts = {split: max(1, round(share * len(cycles))) for split, share in shares.items()}
    left = len(cycles) - sum(counts.values())
    if left < 1:
        raise ValueError(
            f"{scenes.dataset.directory} must hold more than {sum(counts.values())} drop cycles to hold out whole ones "
            f"for {' and '.join(counts)}, got {len(cycles)}: lower data.held_out, or name a folder that has own splits"
        )
    borders = {"train": (0, left)}
    for split in counts:  # val before test
        start = borders[list(borders)[-1]][1]
        borders[split] = (start, start + counts[split])
    return {
        split: DatasetSplit(scenes.dataset, tuple(name for cycle in cycles[a:b] for name in cycle), scenes.part)
        for split, (a, b) in borders.items()
    }


def _range_of(cycles: Sequence[str]) -> str:
    is_single = len(cycles) == 1
    return f"1 drop cycle ({cycles[0]})" if is_single else f"{len(cycles)} drop cycles ({cycles[0]} to {cycles[-1]})"
