"""Which scene sets and clouds of a part nobody refers to."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from attentionvote.command.conf_folder import choices
from attentionvote.command.configuration import compose
from attentionvote.data.sensing import CloudSettings
from attentionvote.files import is_locked, read_json
from attentionvote.registry.references import References
from attentionvote.simulation.sensor import PRESETS
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.prune.holdings import BundleFolder, TrainingFolder, folders_of
from attentionvote.workflows.settings import SPLITS


@dataclass(frozen=True)
class DataUsers:
    """Everything that may refer to the data of a part.

    Args:
        trainings, bundles: that stay.
        evaluations: results of evaluations and baselines.
        named: what the registry names.
    """

    trainings: Sequence[TrainingFolder]
    bundles: Sequence[BundleFolder]
    evaluations: Sequence[Mapping[str, Any]]
    named: References

    @property
    def silent(self) -> Path | None:
        """A training that does not say which data it needs; None when all do."""
        return next((training.path for training in self.trainings if training.data is None), None)

    @property
    def scenes(self) -> set[str]:
        """Digests of scene sets that were trained with or measured on, as far as they are said."""
        scenes = self.named.scenes.union(*(bundle.scenes for bundle in self.bundles))
        scenes |= {str(result["scene_set"]) for result in self.evaluations if result.get("scene_set")}
        return scenes.union(*(training.data.scenes for training in self.trainings if training.data is not None))

    @property
    def clouds(self) -> set[str]:
        """Names of the folders of clouds that were trained with."""
        used: set[str] = set()
        return used.union(*(training.data.clouds for training in self.trainings if training.data is not None))

    @property
    def measured_sets(self) -> set[str]:
        """Digests, of scenes and sensor together, of the evaluations that say no more about their scenes."""
        told = {str(r["evaluation_set"]) for r in self.evaluations if "scene_set" in r}
        bare = {str(r["evaluation_set"]) for r in self.evaluations if r.get("sensor") in PRESETS}
        return (self.named.evaluations | bare) - told


def unreferenced_data(
    part: str, root: Path, users: DataUsers, is_young: Callable[[Path], bool], unjudged: list[str]
) -> Iterator[tuple[str, Path]]:
    """Kind and folder of scene sets and clouds that nobody refers to; interrupted ones when they are old.

    Args:
        part: its name.
        root: where data lie.
        users: of the part.
        is_young: whether a folder was written lately.
        unjudged: gets a sentence about what cannot be judged.
    """
    if users.silent is not None:
        unjudged.append(f"scenes and clouds of {part} are kept, because {users.silent} does not say which it needs")
        return
    sets = {path: _manifest(path) for of, path in folders_of(root / "scenes") if of == part}
    frozen, sensors = _evaluation_choices(part)
    by_measured_set = {
        settings.key(digest): digest for digest, _ in sets.values() if digest for settings in sensors
    }  # fmt: skip
    measured = users.measured_sets
    scenes = users.scenes | frozen | {digest for key, digest in by_measured_set.items() if key in measured}
    unexplained = sorted(measured - set(by_measured_set))
    if unexplained and any(split not in SPLITS for _, split in sets.values()):
        unjudged.append(
            f"evaluation sets of {part} are kept, because an evaluation names {unexplained[0][:12]}, which is none of "
            "them seen by the sensors of conf/evaluation"
        )
    for path, (digest, split) in sets.items():
        needed = digest in scenes if digest else is_young(path)
        if not (needed or (unexplained and split not in SPLITS) or is_locked(path)):
            yield "scenes", path
    for of, path in folders_of(root / "clouds"):
        needed = path.name in users.clouds or (is_young(path) and not _are_measured(path))
        if of == part and not needed and not is_locked(path):
            yield "clouds", path


def _manifest(folder: Path) -> tuple[str, str]:
    """Digest of a scene set's content, empty while it is not complete; and its split."""
    manifest = read_json(folder / "manifest.json") or {}
    return str(manifest.get("content_digest") or ""), folder.name.rpartition("-")[0]


def _are_measured(folder: Path) -> bool:
    """Whether all clouds are there."""
    try:
        return bool(np.load(folder / "done.npy", mmap_mode="r").all()) and (folder / "count.npy").is_file()
    except (OSError, ValueError, EOFError):
        return False


@cache
def _evaluation_choices(part: str) -> tuple[frozenset[str], tuple[CloudSettings, ...]]:
    """Of all files of conf/evaluation the digests that are recorded for a part, and what the sensors see."""
    frozen, sensors = set(), []
    for choice in choices("evaluation"):
        evaluation = compose(EvaluateSettings, ["object=connecting_rod", f"evaluation={choice}"]).evaluation
        frozen |= {digest for name, digest in evaluation.frozen.items() if name == part}
        sensors.append(CloudSettings(evaluation.sensor, density=evaluation.density, pool=evaluation.density))
    return frozenset(frozen), tuple(sensors)
