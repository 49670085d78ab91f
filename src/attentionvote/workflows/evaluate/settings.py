"""Settings of an evaluation: ``conf/evaluate.yaml``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.sections import TRUSTED_KEY, WORKERS, EvaluationSettings, Store
from attentionvote.section import Target
from attentionvote.setting import Setting
from attentionvote.simulation.scene_spec import SimulationSettings


@dataclass(frozen=True, kw_only=True)
class MeasuredBundle(VerbSettings):
    """A bundle and the frozen set that it is measured on."""

    object: Target
    simulation: SimulationSettings
    evaluation: EvaluationSettings
    bundle: Annotated[str, Setting("Bundle below <bundles>/<object>: latest, or the beginning of a digest.")]
    bundles: Annotated[str, Setting("Where bundles lie.")]
    root: Annotated[str, Setting("Where scene sets lie.")]
    trusted_key: Annotated[str | None, TRUSTED_KEY]
    workers: Annotated[int | None, WORKERS]
    tracking: Store


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(MeasuredBundle):
    """An evaluation that is shown and recorded."""

    verb: ClassVar[str] = "evaluate"
    outputs: Annotated[str, Setting("Where results lie.")]
    force: Annotated[bool, Setting("Repeat an evaluation that is done.")]
