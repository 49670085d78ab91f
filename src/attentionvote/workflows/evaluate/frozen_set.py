"""The frozen evaluation set of a part: its specification, its scenes, its recorded digest."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from attentionvote.execution.hardware import cores
from attentionvote.part import Parts, only_part
from attentionvote.simulation.scene_spec import SceneSetSpec, scene_set_directory, scene_set_specs
from attentionvote.workflows.evaluate.settings import MeasuredBundle

if TYPE_CHECKING:
    from attentionvote.measurement.scenes import EvaluationSet, MeasuredScenes

log = logging.getLogger("attentionvote.evaluate")


def set_spec(cfg: MeasuredBundle, part: Parts) -> SceneSetSpec:
    """What determines the frozen set.

    Raises:
        ValueError: when a setting is impossible.
    """
    evaluation = cfg.evaluation
    return _spec(cfg, part, evaluation.split, evaluation.cycles, evaluation.keep_every)


def validation_spec(cfg: MeasuredBundle, part: Parts) -> SceneSetSpec:
    """One whole cycle of validation scenes of the same simulation, to choose a working point on."""
    return _spec(cfg, part, "val", 1, 1)


def _spec(cfg: MeasuredBundle, part: Parts, split: str, cycles: int, keep_every: int) -> SceneSetSpec:
    settings = replace(cfg.simulation, cycles={split: cycles}, keep_every={split: keep_every})
    return scene_set_specs(part, settings)[split]


def scenes_of(cfg: MeasuredBundle, part: Parts) -> MeasuredScenes:
    """The scenes of a dataset when one is named, otherwise the frozen set, generated when it is not there yet.

    Raises:
        ValueError: when the dataset does not hold the part.
    """
    evaluation = cfg.evaluation
    if evaluation.dataset is None:
        return generated_set(cfg, part, set_spec(cfg, part))
    from attentionvote.measurement.dataset_scenes import DatasetScenes

    return DatasetScenes.find(Path(evaluation.dataset), only_part(part, "a dataset's scenes"), evaluation.density)


def generated_set(cfg: MeasuredBundle, part: Parts, spec: SceneSetSpec) -> EvaluationSet:
    """Generated scenes and the sensor that sees them.

    A frozen set whose digest is recorded in ``evaluation.frozen`` and is another one here is used, and said: physics
    is a chain of floating-point operations, and a processor or library that rounds otherwise leads to other piles.
    """
    from attentionvote.data.sensing import CloudSettings
    from attentionvote.measurement.scenes import EvaluationSet
    from attentionvote.simulation.scene_set import generate_scene_set

    directory = scene_set_directory(Path(cfg.root) / "scenes", part.name, spec)
    scenes = generate_scene_set(part, spec, directory, cfg.workers or cores())
    evaluation = cfg.evaluation
    settings = CloudSettings(evaluation.sensor, density=evaluation.density, pool=evaluation.density)
    made = EvaluationSet(scenes, part, settings, spec.split)
    log.info("%s: %s set %s, %d scenes", part.name, spec.split, made.digest[:12], len(made))
    if is_recorded(cfg, part, made) is False:
        log.warning(
            "%s: these scenes are %s, the frozen ones %s: figures of both are not of the same scenes",
            part.name, scenes.digest[:12], evaluation.frozen[part.name][:12],
        )  # fmt: skip
    return made


def is_recorded(cfg: MeasuredBundle, part: Parts, scenes: MeasuredScenes) -> bool | None:
    """Whether scenes are those whose digest is recorded; None when none is, or they are of another kind."""
    from attentionvote.measurement.scenes import EvaluationSet

    recorded = cfg.evaluation.frozen.get(part.name)
    if not recorded or not isinstance(scenes, EvaluationSet) or scenes.split != cfg.evaluation.split:
        return None
    return scenes.scenes.digest == recorded
