"""Recognition of a folder's format by its files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from attentionvote.datasets.bop import BopDataset
from attentionvote.datasets.dataset import Dataset
from attentionvote.datasets.ipa import IpaDataset
from attentionvote.datasets.sileane import CAMERA_FILE, DEPTH_FOLDERS, SileaneDataset

# How far below the given folder a dataset is looked for: formats, datasets, splits, scenes or objects.
LEVELS = 5
LOOKS = {
    "IPA": "<split>/<Object>/ with parameter.json and gt/cycle_*/ or p_depth/cycle_*/",
    "Sileane": "<object>/ with camera_params.txt and gt/*.json or depth/*.PNG",
    "BOP": "<split>/000000/ with scene_camera.json or scene_camera_<sensor>.json",
}


class UnknownLayout(ValueError):
    """A folder that is none of the formats."""


def open_datasets(directory: Path) -> list[Dataset]:
    """Every dataset in a folder, which may be a dataset's own, or hold several splits, objects or formats.

    Raises:
        UnknownLayout: with one sentence, when the folder does not exist or holds none of the formats.
        ValueError: with one sentence, when a file that says what is there is damaged.
    """
    if not directory.is_dir():
        raise UnknownLayout(f"{directory}: the folder of a dataset must exist, got {_what(directory)}")
    folders_by_kind: dict[tuple[Opener, Path, str], list[Path]] = {}
    for folder, opener, group in _folders(directory, LEVELS):
        folders_by_kind.setdefault((opener, folder.parent, group), []).append(folder)
    datasets = [
        dataset for (opener, _, group), folders in folders_by_kind.items() for dataset in opener(folders, group)
    ]
    if not datasets:
        looks = "; ".join(f"{name}: {look}" for name, look in LOOKS.items())
        raise UnknownLayout(f"{directory} must hold a dataset of a known layout, got none of them ({looks})")
    return datasets


def split_of(folder: Path) -> str:
    """``train``, ``test``, ``val`` or ``real`` by a folder's name, else the name itself."""
    name = folder.resolve().name
    for word in ("train", "test", "val", "real"):
        if word in name.lower():
            return word
    return name


def _what(directory: Path) -> str:
    return "a file" if directory.exists() else "nothing there"


Opener = Callable[[list[Path], str], list[Dataset]]


def _folders(folder: Path, levels: int) -> Iterator[tuple[Path, Opener, str]]:
    """Folders of datasets at or below ``folder``, each with what opens it and the group it is opened with."""
    sensors = sorted(path.stem.removeprefix("scene_camera").lstrip("_") for path in folder.glob("scene_camera*.json"))
    if sensors:
        yield from ((folder, _open_bop, sensor) for sensor in sensors)
    elif _is_ipa(folder):
        yield folder, _open_ipa, re.sub(r"_part_\d+$", "", folder.resolve().name)
    elif _is_sileane(folder):
        yield folder, _open_sileane, folder.name
    elif levels > 1:
        for child in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
            yield from _folders(child, levels - 1)


def _is_ipa(folder: Path) -> bool:
    return any(any((folder / name).glob("cycle_*")) for name in ("gt", "p_depth", "p_depth_real_world"))


def _is_sileane(folder: Path) -> bool:
    places = [folder / name for name in ("gt", *DEPTH_FOLDERS)]
    return (folder / CAMERA_FILE).is_file() and any(path.is_dir() for path in places)


def _open_bop(folders: list[Path], sensor: str) -> list[Dataset]:
    return [BopDataset(folders, sensor)]


def _open_sileane(folders: list[Path], _: str) -> list[Dataset]:
    return [SileaneDataset(folder) for folder in folders]


def _open_ipa(folders: list[Path], _: str) -> list[Dataset]:
    split = split_of(folders[0].resolve().parent)
    datasets: list[Dataset] = []
    for depth_folder, real in (("p_depth", False), ("p_depth_real_world", True)):
        having = [folder for folder in folders if (folder / depth_folder).is_dir()]
        if having or (not real and not any((folder / "p_depth_real_world").is_dir() for folder in folders)):
            datasets.append(IpaDataset(having or folders, real, split))
    return datasets
