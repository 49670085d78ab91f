"""Findings about a dataset on disk: files, counts, units, rotations, labels, frames; one sentence each."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from attentionvote.datasets.bop import BopDataset
from attentionvote.datasets.bop_models import models_info_of, read_models_info
from attentionvote.datasets.dataset import LEAST_DROPS, Dataset, Frame
from attentionvote.datasets.ipa import IpaDataset
from attentionvote.datasets.placement import Placement, PlacementCheck

# An instance this visible must have pixels.
CLEARLY_VISIBLE = 0.2
KIND_OF_FILE = {"depth": "depth image", "gt": "ground truth", "labels": "image of labels"}


class Finding(NamedTuple):
    """One thing to know; an ``error`` is wrong, a ``warning`` is no mistake of the files."""

    severity: Literal["error", "warning"]
    sentence: str


class Report(NamedTuple):
    """What a dataset is and what was found.

    Attributes:
        dataset: what was looked at.
        scored: scenes with at least five drops; None where that cannot be read.
        expected: how many there should be; None where nothing says it.
        opened: scenes whose files were read whole.
        instances: parts in them, and in those of which only the poses could be read.
        placement: of poses on points.
        findings: errors first.
    """

    dataset: Dataset
    scored: int | None
    expected: int | None
    opened: int
    instances: int
    placement: Placement
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[str, ...]:
        """The sentences of what is wrong."""
        return tuple(f.sentence for f in self.findings if f.severity == "error")


def check_dataset(
    dataset: Dataset, most_scenes: int = 40, progress: Callable[[int, int], None] | None = None
) -> Report:
    """Look at a dataset: all names and files, and at most ``most_scenes`` scenes whole, spread evenly.

    Args:
        dataset: as ``open_datasets`` gives it.
        most_scenes: how many are opened, the last one among them. Of a scene without its picture the poses are read.
        progress: called with the number of scenes done and the number to do.
    """
    where = f"{dataset.title}, {dataset.split}"
    findings = _of_counts(dataset, where) + _of_models(dataset)
    lacking = _of_files(dataset, where, findings)
    last = len(dataset.names) - 1
    opened_indices = sorted({round(share * last) for share in 1 - np.linspace(0, 1, most_scenes)}) if last >= 0 else []
    problems: dict[str, list[str]] = defaultdict(list)
    placement, opened, instances = _try_diameters(dataset, findings), 0, 0
    for done, index in enumerate(opened_indices):
        name = dataset.names[index]
        try:
            if not lacking.get(name):
                frame = dataset.frame(name)
                placement.add(dataset.scene_of(name, frame, remove_background=False))
                opened, instances = opened + 1, instances + len(frame.ground_truth.part_ids)
                for kind, sentence in _of_labels(frame, name) if dataset.has_labels else ():
                    problems[kind].append(f"{where}: {sentence}")
            elif "gt" not in lacking[name]:
                instances += len(dataset.ground_truth(name).part_ids)
        except (ValueError, OSError) as error:
            sentence = " ".join(str(error).split())
            problems[_kind(sentence)].append(sentence)
        if progress is not None:
            progress(done + 1, len(opened_indices))
    findings += [Finding("error", _first_of(sentences)) for sentences in problems.values()]
    verdict = placement.judge()
    if verdict.is_wrong:
        remedy = f": with {verdict.remedy} they would, so the frame is mixed up" if verdict.remedy else ""
        sentence = (
            f"{where}: poses must lie on the points of their instance, {verdict.misplaced} of "
            f"{verdict.looked_at} are farther than D from them{remedy}"
        )
        findings.append(Finding("error", sentence))
    findings.sort(key=lambda finding: finding.severity != "error")
    return Report(dataset, _scored(dataset), _expected(dataset), opened, instances, verdict, tuple(findings))


def _of_files(dataset: Dataset, where: str, findings: list[Finding]) -> dict[str, set[str]]:
    """The kinds of files that a scene lacks, by its name."""
    if not dataset.names:
        findings.append(Finding("error", f"{where}: there must be scenes, got none in {dataset.directory}"))
        return {}
    try:
        missing = dataset.missing_files()
    except (ValueError, OSError) as error:
        findings.append(Finding("error", " ".join(str(error).split())))
        return {}
    for kind, names in missing.items():
        if not names:
            continue
        nowhere = len(names) == len(dataset.names)
        # Public test sets of BOP come without poses: that is what they are.
        severity: Literal["error", "warning"] = (
            "warning" if dataset.format == "bop" and kind == "gt" and nowhere else "error"
        )
        many = "every scene lacks" if nowhere else f"{len(names)} of {len(dataset.names)} scenes lack"
        findings.append(Finding(severity, f"{where}: {many} its {KIND_OF_FILE[kind]}, the first is {names[0]}"))
    if not dataset.has_labels:
        findings.append(Finding("warning", f"{where}: there are no images of labels, so points have no instance"))
    lacking: dict[str, set[str]] = defaultdict(set)
    for kind, names in missing.items():
        for name in names:
            lacking[name].add(kind)
    return lacking


def _of_counts(dataset: Dataset, where: str) -> list[Finding]:
    warnings = []
    scored, expected = _scored(dataset), _expected(dataset)
    if expected is not None and scored is not None and scored != expected:
        what = "the Sileane set" if dataset.format == "sileane" else "the paper's Table 1"
        warnings.append(f"{what} has {expected} scenes with at least {LEAST_DROPS} drops, here are {scored}")
    paper_set = isinstance(dataset, IpaDataset) and not dataset.is_generated
    if paper_set and dataset.benchmark and dataset.split not in ("train", "test", "real"):
        warnings.append("the folder's name says neither train nor test, so the counts are not compared")
    if paper_set and dataset.parts == ("ring_screw",) and dataset.split == "test":
        warnings.append(
            "depth and labels of the synthetic test set of the ring screw are known not to fit (paper section 4.1): "
            "use the real one"
        )
    findings = [Finding("warning", f"{where}: {sentence}") for sentence in warnings]
    return findings + (_of_cycles(dataset, where) if isinstance(dataset, IpaDataset) and paper_set else [])


def _of_models(dataset: Dataset) -> list[Finding]:
    """What a dataset's models say of themselves; their diameters were read when it was opened."""
    info = models_info_of(dataset.directory) if isinstance(dataset, BopDataset) else None
    try:
        if info is not None:
            read_models_info(info)
    except ValueError as error:
        return [Finding("error", " ".join(str(error).split()))]
    return []


def _of_cycles(dataset: IpaDataset, where: str) -> list[Finding]:
    """Numbers of drops that a cycle of the paper's objects jumps over; generated sets may keep a few piles only."""
    cycles: dict[str, set[int]] = defaultdict(set)
    for name in dataset.names:
        cycles[name.partition("/")[0]].add(dataset.drop_count(name))
    gaps = [(cycle, sorted(set(range(max(counts))) - counts)) for cycle, counts in cycles.items()]
    gaps = [(cycle, lacking) for cycle, lacking in gaps if lacking]
    if not gaps or dataset.benchmark is None:
        return []
    cycle, lacking = gaps[0]
    more = f" ({len(gaps) - 1} more cycles have gaps)" if len(gaps) > 1 else ""
    return [Finding("error", f"{where}: {cycle} must have every number of drops, it lacks {lacking[0]:03d}{more}")]


def _of_labels(frame: Frame, name: str) -> list[tuple[str, str]]:
    findings = []
    if frame.unknown_pixels:
        sentence = f"every label must be an instance's, {frame.unknown_pixels} pixels of {name} have another"
        findings.append(("unknown", sentence))
    pixels = np.bincount(frame.instance[frame.instance >= 0], minlength=len(frame.ground_truth.part_ids))
    empty = np.flatnonzero((pixels == 0) & (frame.ground_truth.visible_fraction >= CLEARLY_VISIBLE))
    if len(empty):
        row = int(empty[0])
        visible = f"part {row} of {name} is visible to {frame.ground_truth.visible_fraction[row]:.0%}"
        findings.append(("empty", f"every visible part must have pixels, {visible} and has none"))
    return findings


def _scored(dataset: Dataset) -> int | None:
    try:
        return len(dataset.scored_names)
    except (ValueError, OSError):
        return None


def _expected(dataset: Dataset) -> int | None:
    benchmark = dataset.benchmark
    if benchmark is None or dataset.format == "bop" or dataset.is_generated:
        return None
    if dataset.format == "sileane":
        return benchmark.sileane and benchmark.sileane[0] * (benchmark.sileane[1] - LEAST_DROPS)
    return benchmark.expected_ipa_scenes(dataset.split)


def _try_diameters(dataset: Dataset, findings: list[Finding]) -> PlacementCheck:
    try:
        return PlacementCheck(dataset.diameters, dataset.camera_from_file)
    except (ValueError, OSError) as error:
        findings.append(Finding("error", " ".join(str(error).split())))
        return PlacementCheck(())


def _kind(sentence: str) -> str:
    """The sentence without what differs from file to file: paths and numbers."""
    return re.sub(r"[-+\d.e]*\d[-+\d.e]*", "#", re.sub(r"\S*/\S*", "", sentence))


def _first_of(sentences: list[str]) -> str:
    return sentences[0] + (f" (and {len(sentences) - 1} more like it)" if len(sentences) > 1 else "")
