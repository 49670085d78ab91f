"""What stands in one cell of a benchmark's table: a trained, exported, evaluated model, or a classical baseline."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.command.configuration import compose
from attentionvote.files import read_json, write_json
from attentionvote.workflows.chain import MemberTask
from attentionvote.workflows.evaluate.settings import EvaluateSettings
from attentionvote.workflows.tables.table import Row
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from attentionvote.part import Part

log = logging.getLogger("attentionvote.benchmark")
_CELL_KEYS = (
    "figures",
    "intervals",
    "thresholds",
    "ap_by_threshold",
    "scenes",
    "evaluation_set",
    "frozen",
    "sensor",
    "machine",
)


class CellFailed(Exception):
    """A cell that was to be measured could not be; one sentence."""


def network_cell(words: dict[str, tuple[str, ...]], name: str, may_train: bool) -> dict[str, Any] | None:
    """The cell of a model, from verbs that do nothing when it is there already.

    Args:
        words: of ``train``, ``export`` and ``evaluate``.
        name: of the part.
        may_train: otherwise a model that is not trained is None.

    Raises:
        CellFailed: when a verb failed.
        ValueError: when the training's configuration is impossible.
    """
    from attentionvote.workflows.train.job import find_training

    cfg = compose(TrainSettings, [f"object={name}", *words["train"]])
    job = find_training(cfg)
    if job.result is None and not may_train:
        return None
    answers = MemberTask(words, None)(name)
    if answers.get("failed"):
        raise CellFailed(f"{answers['failed']} failed, {answers['sentence']}")
    trained, evaluated = answers["train"], answers["evaluate"]
    return {key: evaluated[key] for key in _CELL_KEYS} | {
        "budget": {
            "steps": trained["steps"],
            "train_seconds": trained["train_seconds"],
            "train_scenes": job.scene_counts["train"],
        },
        "seed": cfg.seed,
        "commit": trained["commit"],
        "bundle": evaluated["bundle"],
        "run_id": trained["run_id"],
    }


def cells_of_parts(cell: Mapping[str, Any] | None, parts: Sequence[str]) -> dict[str, dict[str, Any] | None]:
    """What a cell of several parts in one bin says of each of these; the time of a scene is that of all.

    Raises:
        CellFailed: when one is not in the bin.
    """
    return {part: None if cell is None else _cell_of_part(cell, part) for part in parts}


def _cell_of_part(cell: Mapping[str, Any], part: str) -> dict[str, Any]:
    begin = f"{part}/"
    part_figures = {
        kind: {name.removeprefix(begin): value for name, value in cell[kind].items() if name.startswith(begin)}
        for kind in ("figures", "intervals")
    }
    if not part_figures["figures"]:
        raise CellFailed(f"the bin must hold the part {part}, got none")
    times = {name: value for name, value in cell["figures"].items() if name.startswith("latency_")}
    shared = {key: value for key, value in cell.items() if key not in ("thresholds", "ap_by_threshold")}
    return shared | part_figures | {"figures": part_figures["figures"] | times}


def baseline_cell(
    evaluate: Sequence[str], name: str, row: Row, folder: Path, workers: int, changed: Mapping[str, Any]
) -> dict[str, Any]:
    """The cell of a classical baseline on the scenes that the models are measured on.

    Its working point is chosen on a cycle of validation scenes, as a model's is.

    Args:
        evaluate: words of ``evaluate``.
        name: of the part.
        row: of the table.
        folder: keeps what is measured.
        workers: processes; the time of a scene is of one.
        changed: settings of the detector other than those of its variant.

    Raises:
        ValueError: when the baseline's library is missing, or the scenes cannot be had.
    """

    from attentionvote.measurement.baseline_scenes import VARIANTS, baseline_results, identity
    from attentionvote.measurement.figures import figures_of, machine
    from attentionvote.measurement.models import Measurement
    from attentionvote.tracking.provenance import git_state
    from attentionvote.training.operating_point import best_threshold
    from attentionvote.workflows.evaluate.frozen_set import generated_set, is_recorded, scenes_of, validation_spec

    cfg = compose(EvaluateSettings, [f"object={name}", *evaluate])
    part: Part = cfg.object()
    settings = replace(VARIANTS[row.detector], **changed)
    frozen = scenes_of(cfg, part)
    path = folder / row.detector / f"{name}-{identity(settings, frozen.digest, part)[:12]}.json"
    stored = read_json(path)
    if stored is not None and not cfg.force:
        return stored | {"frozen": is_recorded(cfg, part, frozen)}
    validation = generated_set(cfg, part, validation_spec(cfg, part))
    log.info("%s, %s: %d scenes, and %d for its working point", row.name, name, len(frozen), len(validation))
    measured_sets = []
    for scenes in (validation, frozen):
        clouds = list(_shown(scenes.clouds(), f"{name}: clouds", len(scenes)))
        bar = partial(_shown, title=f"{row.name}, {name}", total=len(clouds))
        measured_sets.append(baseline_results(part, clouds, settings, workers, shown=bar))
    (validation_results, _), (results, seconds) = measured_sets
    measured = Measurement(
        row.detector, results, frozen.cycle_of_scene, best_threshold(validation_results, part), seconds
    )
    cell = figures_of(measured, part) | {
        "scenes": len(frozen),
        "evaluation_set": frozen.digest,
        "frozen": is_recorded(cfg, part, frozen),
        "sensor": frozen.title,
        "machine": machine(),
        "budget": None,
        "seed": cfg.simulation.seed,
        "commit": git_state(Path.cwd()).label,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, cell)
    return cell


def _shown(items: Iterator[Any], title: str, total: int) -> Iterable[Any]:
    from rich.console import Console
    from rich.progress import track

    return track(items, title, total, console=Console(stderr=True))
