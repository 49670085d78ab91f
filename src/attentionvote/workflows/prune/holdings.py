"""What lies on the disk: trainings, bundles, scene sets, clouds, and the files that name them."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from attentionvote.files import is_locked, read_json
from attentionvote.inference.bundles.manifest import CARD, MANIFEST
from attentionvote.workflows.train.job import MODEL, RESULT, RUN

log = logging.getLogger("attentionvote.prune")
CHECKPOINTS, LATEST = "checkpoints", "latest"
TRIALS, LEADERBOARD = "trials.json", "leaderboard.json"
_ELSE = {"mlartifacts", "logs", LATEST}  # MLflow's, what verbs say, and a link to a bundle beside it


@dataclass(frozen=True)
class TrainingFolder:
    """A training's folder."""

    path: Path

    @property
    def part(self) -> str:
        """Name of the part."""
        return self.path.parent.name

    @property
    def complete(self) -> bool:
        """Whether it came to its end."""
        return (self.path / RESULT).is_file() and (self.path / MODEL).is_file()

    @cached_property
    def run_id(self) -> str:
        """Of its run; empty before there is one."""
        for name in (RUN, RESULT):
            if run_id := (read_json(self.path / name) or {}).get("run_id"):
                return str(run_id)
        return ""

    @cached_property
    def data(self) -> TrainedWith | None:
        """What it was trained with; None when nothing readable says so."""
        from attentionvote.data.sensing import CloudSettings
        from attentionvote.training.checkpoint import read_metadata

        for name in (MODEL, f"{CHECKPOINTS}/last.ckpt", f"{CHECKPOINTS}/best.ckpt"):
            try:
                metadata = read_metadata(self.path / name)
                digests = {str(digest) for digest in metadata["data"].values()}
                settings = CloudSettings.of(metadata["clouds"])
            except FileNotFoundError:
                continue
            except (ValueError, KeyError, TypeError) as error:
                log.warning("%s does not say what it was trained with: %s", self.path / name, error)
                continue
            if digests:
                return TrainedWith(digests, {settings.key(digest)[:16] for digest in digests})
        return None


@dataclass(frozen=True)
class TrainedWith:
    """Digests of the scenes of a training, and the folders of their clouds."""

    scenes: set[str]
    clouds: set[str]


@dataclass(frozen=True)
class BundleFolder:
    """A bundle's folder."""

    path: Path

    @property
    def part(self) -> str:
        """Name of the part."""
        return self.path.parent.name

    @property
    def is_latest(self) -> bool:
        """Whether ``latest`` points at it."""
        link = self.path.with_name(LATEST)
        return link.is_symlink() and link.resolve() == self.path.resolve()

    @cached_property
    def digest(self) -> str:
        """Its name among bundles."""
        return hashlib.sha256((self.path / MANIFEST).read_bytes()).hexdigest()

    @cached_property
    def card(self) -> Mapping[str, Any]:
        """Its card, unchecked; empty when it cannot be read."""
        return read_json(self.path / CARD) or {}

    @property
    def run_id(self) -> str:
        """Of the training; empty when the card names none."""
        return str(self.card.get("run_id") or "")

    @property
    def scenes(self) -> set[str]:
        """Digests of the scenes that it was trained with."""
        return {str(digest) for digest in (self.card.get("data") or {}).values()}


@dataclass
class Holdings:
    """What a walk through folders of results met.

    Attributes:
        trainings, bundles: every one.
        evaluations: results of evaluations, by part.
        listed: folder names and run ids of trainings in the tables of sweeps.
        shown: digests of bundles in leaderboards.
        locks: folders that processes work in from time to time, relative to the folder of results.
    """

    trainings: list[TrainingFolder] = field(default_factory=list)
    bundles: list[BundleFolder] = field(default_factory=list)
    evaluations: dict[str, list[Mapping[str, Any]]] = field(default_factory=dict)
    listed: set[str] = field(default_factory=set)
    shown: set[str] = field(default_factory=set)
    locks: list[tuple[Path, Path]] = field(default_factory=list)

    @classmethod
    def below(cls, roots: Iterable[Path]) -> Holdings:
        """Everything below folders of results; what is being removed is left out."""
        holdings, walked = cls(), set[Path]()
        for root in roots:
            # Folders of results may be links to another disk.
            for folder, folders, files in os.walk(root, followlinks=True):
                path, names = Path(folder), set(files)
                if path.resolve() in walked:
                    folders.clear()
                    continue
                walked.add(path.resolve())
                folders[:] = sorted(f for f in folders if f not in _ELSE and not f.startswith("."))
                if ".lock" in names:
                    holdings.locks.append((path.relative_to(root), path))
                if {MANIFEST, CARD} <= names:
                    holdings.bundles.append(BundleFolder(path))
                    folders.clear()
                elif names & {RUN, RESULT, MODEL} or CHECKPOINTS in folders or [*names, *folders] == [".lock"]:
                    holdings.trainings.append(TrainingFolder(path))
                    folders.clear()
                else:
                    for name in files:
                        if name.endswith(".json"):
                            holdings._read(path / name)
        return holdings

    def busy(self, part: str) -> Path | None:
        """A folder in which a process works with the part's data, or may; None when there is none."""
        parts = {training.part for training in self.trainings} | {bundle.part for bundle in self.bundles}
        for relative, path in self.locks:
            others = (parts - {part}) & set(relative.parts)
            if (part in relative.parts or not others) and is_locked(path):
                return path
        return None

    def _read(self, path: Path) -> None:
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return
        if path.name == TRIALS and isinstance(content, list):
            for row in content:
                self.listed |= {Path(str(row.get("directory") or ".")).name, str(row.get("run_id") or "")}
            self.listed.discard("")
        elif path.name == LEADERBOARD and isinstance(content, dict):
            for row in content.get("members", []):
                champion = row.get("champion") or {}
                self.shown |= {str(row.get("bundle") or ""), str(champion.get("bundle") or "")}
            self.shown.discard("")
        elif isinstance(content, dict) and content.get("evaluation_set"):
            part = str(content.get("object") or path.stem.rpartition("-")[0] or path.parent.name)
            self.evaluations.setdefault(part, []).append(content)


def folders_of(root: Path) -> Iterator[tuple[str, Path]]:
    """``root/PART/NAME`` as part and folder, links and what is being removed left out."""
    for folder in sorted(root.glob("*/*")):
        hidden = folder.name.startswith(".") or folder.parent.name.startswith(".")
        if folder.is_dir() and not folder.is_symlink() and not hidden:
            yield folder.parent.name, folder


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files below a folder; what goes away meanwhile counts nothing."""
    total = 0
    for file in [path] if not path.is_dir() or path.is_symlink() else path.rglob("*"):
        try:
            status = file.lstat()
        except FileNotFoundError:
            continue
        total += 0 if file.is_dir() and not file.is_symlink() else status.st_size
    return total


def written_s(path: Path) -> float:
    """When a folder or anything in it was written last, seconds since 1970."""
    times = [0.0]
    for file in [path, *path.rglob("*")]:
        try:
            times.append(file.lstat().st_mtime if file.name != ".lock" else 0.0)
        except FileNotFoundError:
            continue
    return max(times)
